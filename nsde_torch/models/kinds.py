"""The kinds of models of the package: what each is made of, from what the user chose, the machine and the data.

sigma_max      learned; the system's with loss=paper or where the user declares it
input filter   as many taps as undo the smoothing that the training runs show; none with loss=paper
sensor noise   learned by innovations, and where the system asks for it
disturbance    where the system has ports for one
integrator     of second order in the drift for innovations, without noise for models without diffusion

How each is fitted lies a layer above, and is named by where it lies: who flies a model need not load what trains it.
"""

from dataclasses import fields
from typing import Any, ClassVar, final

from nsde_torch.models.ensemble import EnsembleSpec, GaussianEnsemble
from nsde_torch.models.feedback_model import LAGS
from nsde_torch.models.identified import IdentifiedModel, SysidSpec
from nsde_torch.models.kind import Choice, ModelKind
from nsde_torch.models.neural_sde import NeuralSDE, SDESpec
from nsde_torch.models.options import (
    BlackboxOptions,
    EnsembleOptions,
    NodeOptions,
    NsdeOptions,
    SysidOptions,
)


class _Equation(ModelKind):
    """What the neural SDE, the neural ODE and the SDE without physics have in common."""

    spec = SDESpec
    model = NeuralSDE
    fitted_by = "nsde_torch.training.fit_sde:fit_sde"
    physics: ClassVar[bool] = True
    learns_lag: ClassVar[bool] = True

    @classmethod
    def make_spec(cls, choice: Choice) -> SDESpec:
        solver = cls.step(choice)
        paper = choice.loss == "paper"
        innovations = cls.physics and choice.loss == "innovations"
        plain = paper or solver.deterministic
        machine, common = choice.machine, choice.common
        chosen = {f.name: getattr(choice.options, f.name) for f in fields(choice.options)}
        learned = (chosen.get("sigma") or ("declared" if paper else "learned")) == "learned"
        declared = None if learned else tuple(machine.defaults.sigma_max)
        widths: dict[str, Any] = {k: tuple(v) for k, v in chosen.items() if k.endswith("_hidden")}
        reach = chosen["filter_reach"]
        if reach is None:
            reach = 0 if paper else choice.filter_reach
        measurement, disturbance = chosen.get("measurement"), chosen.get("disturbance")
        if measurement is None:
            measurement = not plain and (innovations or machine.sensor_noise)
        if disturbance is None:
            disturbance = not plain and bool(machine.disturbed_ports)
        sigma_max = choice.system.sigma_max
        return SDESpec(
            **common,
            **widths,
            step=cls.step_name(choice),
            solver=choice.integrator.settings,
            physics=cls.physics,
            sigma_max=declared if sigma_max is None else tuple(sigma_max),
            filter_reach=reach,
            measurement=measurement,
            disturbance=cls.physics and disturbance,
            learn_lag=innovations and cls.learns_lag and chosen["learn_lag"],
            loss=choice.loss,
            feedback=LAGS if innovations and not plain and chosen.get("learn_feedback") else 0,
        )


@final
class NeuralSDEKind(_Equation):
    """Declared physics, residual networks, distance-aware diffusion."""

    options = NsdeOptions

    @classmethod
    def own_step(cls, choice: Choice) -> str:
        """See `ModelKind.own_step`.

        A model of innovations has the parameters of the machine, not those that make up for a coarse step: its own is
        one of second order in the drift.
        """
        return "milstein_heun" if choice.loss == "innovations" else super().own_step(choice)


@final
class NeuralODEKind(_Equation):
    """The same drift, no diffusion."""

    options = NodeOptions
    noise = False


@final
class BlackboxKind(_Equation):
    """A network of state and input is the whole drift."""

    options = BlackboxOptions
    noise = True
    physics = False
    learns_lag = False


@final
class EnsembleKind(ModelKind):
    """Networks that predict mean and variance of the next state."""

    options = EnsembleOptions
    spec = EnsembleSpec
    model = GaussianEnsemble
    fitted_by = "nsde_torch.training.fit_ensemble:fit_ensemble"

    @classmethod
    def make_spec(cls, choice: Choice) -> EnsembleSpec:
        chosen = choice.options
        assert isinstance(chosen, EnsembleOptions)
        own = {k: v for k, v in vars(chosen).items() if k not in ("kind", "hidden")}
        return EnsembleSpec(**choice.common, **own, hidden=tuple(chosen.hidden))


@final
class SysidKind(ModelKind):
    """The declared physics by least squares, and nothing else."""

    options = SysidOptions
    spec = SysidSpec
    model = IdentifiedModel
    fitted_by = "nsde_torch.training.fit_sysid:fit_sysid"
    noise = False
    compiles = False  # done before it compiles

    @classmethod
    def make_spec(cls, choice: Choice) -> SysidSpec:
        chosen = choice.options
        assert isinstance(chosen, SysidOptions)
        cls.step(choice)  # refuses one that does not fit
        reach = choice.filter_reach
        return SysidSpec(
            **choice.common,
            # restored inputs lack what is fast: weights by the noise would trust them most where they say least
            method=chosen.method or ("differences" if reach else "weak"),
            filter_reach=reach,
            max_iterations=chosen.max_iterations,
            step=cls.step_name(choice),
            solver=choice.integrator.settings,
        )
