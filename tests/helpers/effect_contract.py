"""What holds for every effect. A test class of an effect inherits `EffectContract` and names it."""

from collections.abc import Mapping

import pytest
import torch
from torch import Tensor

from nsde_torch.effects import EFFECTS, Effect, Port, key_of
from nsde_torch.effects.law import split_name
from nsde_torch.systems import SYSTEMS, System, make_system, system_class


class EffectContract:
    """Inherit, and set `name` and a `system` that has the effect's port.

    Attributes:
        name: Key in `EFFECTS`, or `module:Class`.
        system: System that it is tried on.
        memory: Extra states that it is to carry.
        size: Size of the states that it is tried on.
        signed: Whether it is tried on inputs of both signs.
        values: Values with which every parameter matters, where the first ones are not such.
        time: Time at which it is tried [s].
    """

    name: str
    system: str
    memory: int = 0
    size: float = 1.0
    signed: bool = False
    values: Mapping[str, float | list[float]] | None = None
    time: float = 0.3

    @property
    def effect(self) -> type[Effect]:
        """The class that the name is on the system."""
        return system_class(self.system).effect_class(self.name)

    def machine(self, **options: object) -> System:
        """The system with this effect and no other."""
        return make_system(self.system, declared=[], effects=[self.name], **options)  # type: ignore[arg-type]

    def make(self, values: Mapping[str, float | list[float]] | None = None) -> Effect:
        return make_system(self.system, declared=[]).make_effect(self.name, values)

    def rows(self, n: int, *, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
        """States, inputs and some memory, float64."""
        s, g = self.machine(), torch.Generator().manual_seed(seed)
        x = self.size * torch.randn(n, s.nx, generator=g, dtype=torch.float64)
        if s.quaternion is not None:
            x[:, s.quaternion] /= x[:, s.quaternion].norm(dim=1, keepdim=True)
        u = torch.rand(n, self.columns(), generator=g, dtype=torch.float64)
        u = 2.0 * u - 1.0 if self.signed else u
        return x, u, torch.rand(n, self.memory, generator=g, dtype=torch.float64)

    def columns(self) -> int:
        """Columns of what the effect is given as its input."""
        cls = self.effect
        return len(system_class(self.system).input_names) + len(cls.exogenous) + sum(cls.quantities.values())

    # ---- description ----------------------------------------------------------------------------------

    def test_it_says_what_it_is_and_where_it_comes_from(self) -> None:
        cls = self.effect
        assert system_class(self.system).effect_key(self.name) in (cls.name, key_of(cls))
        assert cls.formula
        assert cls.source
        assert isinstance(cls.port, Port)
        assert set(cls.systems) <= set(SYSTEMS)
        assert cls.sentence.format(**cls.PARAMETERS)
        assert cls.separate
        assert {split_name(name)[0] for name in cls.includes} <= set(EFFECTS)

    def test_every_parameter_has_a_unit_and_a_first_value_inside_its_bounds(self) -> None:
        declared = self.make().declared_parameters()
        assert list(declared) == list(self.effect.PARAMETERS)
        for name, spec in self.effect.PARAMETERS.items():
            value, unit = declared[name]
            assert unit == spec.unit != ""
            assert spec.help
            expected = torch.as_tensor(spec.initial, dtype=value.dtype).reshape(-1).expand(len(value))
            torch.testing.assert_close(value, expected, rtol=1e-5, atol=1e-7)

    # ---- parameters -----------------------------------------------------------------------------------

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_a_value_that_is_set_is_the_value_that_is_read(self, dtype: torch.dtype) -> None:
        effect = self.make().to(dtype)
        for name, spec in self.effect.PARAMETERS.items():
            low = spec.low if spec.low is not None else -20.0
            high = spec.high if spec.high is not None else low + 40.0
            for share in (1e-3, 0.1, 0.5, 0.9, 0.999):
                wanted = torch.full((effect.raw[name].numel(),), low + share * (high - low)).double()
                effect.set_value(name, wanted)
                torch.testing.assert_close(effect.value(name).double(), wanted, rtol=2e-4, atol=1e-6)

    def test_an_optimiser_cannot_leave_the_bounds(self) -> None:
        for sign in (-1.0, 1.0):
            effect = self.make()
            optimiser = torch.optim.Adam(effect.raw.values(), lr=10.0)
            for _ in range(20 if effect.raw else 0):
                optimiser.zero_grad()
                (sign * sum(effect.value(name).sum() for name in self.effect.PARAMETERS)).backward()
                optimiser.step()
            for name, spec in self.effect.PARAMETERS.items():
                value = effect.value(name)
                assert bool(torch.isfinite(value).all())
                assert spec.low is None or bool((value >= spec.low).all())
                assert spec.high is None or bool((value <= spec.high).all())

    def test_the_gradient_reaches_every_parameter(self) -> None:
        effect = self.make(self.values).double()
        x, u, memory = self.rows(8)
        term, rate = effect(self.time, x, u, memory), effect.memory_rate(self.time, x, u, memory)
        (term.sum() + rate.sum()).backward()
        for name in self.effect.PARAMETERS:
            gradient = effect.raw[name].grad
            assert bool(torch.isfinite(gradient).all())
            assert bool((gradient != 0).any())

    # ---- what a diagnosis asks ------------------------------------------------------------------------

    def test_it_adds_nothing_at_the_values_that_say_so(self) -> None:
        cls = self.effect
        assert cls.null
        assert {*cls.null, *cls.shapes} <= set(cls.PARAMETERS)
        assert set(cls.amplitudes) <= set(cls.null)
        assert set(cls.relative) <= set(cls.shapes)
        assert set(cls.null) | set(cls.shapes) == set(cls.PARAMETERS)
        sizes = dict.fromkeys(cls.relative.values(), 1.0)
        x, u, _ = self.rows(6)
        for start in cls.starts(sizes, frequencies=(1.0, 2.0)):
            for name in cls.null:  # a shape may be of the null too: a lag has nothing else
                start[name] = cls._inside(cls.null)[name]
            effect = self.make(start).double()
            term = effect(self.time, x, u, effect.memory_start(x, u))
            assert float(term.detach().abs().max()) < 1e-4

    def test_it_is_linear_in_its_amplitudes(self) -> None:
        cls = self.effect
        x, u, memory = self.rows(6)

        def term(share: float) -> Tensor:
            effect = self.make(self.values).double()
            for name in cls.amplitudes:
                full = effect.value(name).detach() + 0.3
                effect.set_value(name, share * full)
            return effect(self.time, x, u, memory).detach()

        if cls.amplitudes:
            torch.testing.assert_close(term(0.5), 0.5 * term(1.0) + 0.5 * term(1e-9), rtol=1e-4, atol=1e-6)

    def test_time_may_be_a_number_or_one_for_each_row(self) -> None:
        effect = self.make(self.values).double()
        x, u, memory = self.rows(4)
        one = effect(self.time, x, u, memory)
        for t in (torch.tensor(self.time), torch.full((4,), self.time)):
            torch.testing.assert_close(effect(t.double(), x, u, memory), one)

    # ---- the term -------------------------------------------------------------------------------------

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_the_term_fits_its_port(self, dtype: torch.dtype) -> None:
        effect = self.make().to(dtype)
        x, u, memory = (v.to(dtype) for v in self.rows(5))
        term = effect(0.0, x, u, memory)
        assert term.shape == (5, self.machine().width_of(self.effect.port))
        assert term.dtype == dtype
        assert bool(torch.isfinite(term).all())

    def test_rows_do_not_know_of_each_other(self) -> None:
        effect = self.make().double()
        x, u, memory = self.rows(6)
        together = effect(0.0, x, u, memory)
        for k in range(6):
            alone = effect(0.0, x[k : k + 1], u[k : k + 1], memory[k : k + 1])
            torch.testing.assert_close(alone[0], together[k])

    def test_gradients_are_finite_at_rest(self) -> None:
        effect = self.make().double()
        s = self.machine()
        x = torch.zeros(1, s.nx, dtype=torch.float64)
        if s.quaternion is not None:
            x[:, s.quaternion.start] = 1.0
        x.requires_grad_()
        u = torch.ones(1, self.columns(), dtype=torch.float64)
        u[:, : s.nu] = 0.0
        u.requires_grad_()
        effect(0.0, x, u, torch.zeros(1, self.memory, dtype=torch.float64)).sum().backward()
        for tensor in (x, u, *effect.parameters()):
            assert tensor.grad is None or bool(torch.isfinite(tensor.grad).all())

    def test_a_system_with_it_has_a_finite_drift(self) -> None:
        s = self.machine().double()
        x, u, _ = self.rows(7)
        z = s.augment(x, u)
        assert s.nz == s.nx + self.memory
        assert s.drift(0.0, z, u).shape == z.shape == (7, s.nz)
        assert bool(torch.isfinite(s.drift(0.0, z, u)).all())

    # ---- memory ---------------------------------------------------------------------------------------

    def test_it_carries_the_memory_that_it_states(self) -> None:
        effect = self.make()
        x, u, memory = self.rows(4)
        assert effect.n_memory == self.memory
        assert effect.memory_start(x, u).shape == (4, self.memory)
        assert effect.double().memory_rate(0.0, x, u, memory).shape == (4, self.memory)

    def test_its_memory_starts_at_rest(self) -> None:
        effect = self.make().double()
        x, u, _ = self.rows(4)
        rate = effect.memory_rate(0.0, x, u, effect.memory_start(x, u))
        torch.testing.assert_close(rate, torch.zeros_like(rate))


def contract(name: str, system: str, **tried: object) -> type[EffectContract]:
    """The test class of an effect that has no test beside its contract; assign it to a name that begins with Test."""
    return type(name, (EffectContract,), {"name": name, "system": system, **tried})
