"""Physics and its regression: values that were found, channels that parameters move, kinds of parameters."""

import numpy as np
from numpy.typing import NDArray

from nsde_torch.effects import Effect, Law, effect_class
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems import System
from nsde_torch.systems.parameters import ParameterVector, own_name

Array = NDArray[np.float64]

_AT_BOUND = 2e-6  # typical sizes from a bound; the optimiser keeps values a millionth off it
_MOVES = 1e-6  # of the largest slope of a parameter: below that is rounding


def dynamic_rows(system: System) -> NDArray[np.int64]:
    """Channels that physics moves: not positions, nor a quaternion, which kinematics tie to others."""
    tied = {position for position, _, _ in system.position_derivatives}
    q = system.quaternion
    kept = [
        i
        for i, name in enumerate(system.state_names)
        if name not in tied and not (q is not None and q.start <= i < q.stop)
    ]
    return np.array(kept, dtype=np.int64)


def moved_channels(regression: Regression, effect: str) -> tuple[str, ...]:
    """Names of the channels that the parameters of an effect move: whose whitened slopes are not zero."""
    size = np.linalg.norm(regression.slopes[:, :, regression.vector.of(effect)], axis=1)
    moves = (size > _MOVES * np.maximum(size.max(0), 1e-300)).any(1)
    names = [regression.physics.names[c] for c in regression.rows]
    return tuple(name for name, m in zip(names, moves, strict=True) if m)


def fitted_system(regression: Regression) -> System:
    """The physics with the values of a regression."""
    source = regression.origin
    assert isinstance(source, System)
    out = source.with_effects()
    regression.vector.write(out, regression.theta)
    return out


def effect_of(system: System, name: str) -> Effect:
    """The effect of a system that has this name."""
    return next(e for e in system.effects if isinstance(e, Effect) and e.name == name)


def values_of(effect: Effect) -> dict[str, float | list[float]]:
    return {
        key: value.tolist() if value.numel() > 1 else float(value)
        for key, (value, _) in effect.declared_parameters().items()
    }


def nonlinear(vector: ParameterVector, *, smooth: bool = True) -> NDArray[np.bool_]:
    """Parameters that say where or how fast an effect sets in, not how strong it is (k,); or not the smooth of them."""
    out = np.zeros(len(vector), dtype=bool)
    effects = {e.name: type(e) for e in vector.system.effects if isinstance(e, Effect)}
    for j, label in enumerate(vector.labels):
        effect, dot, _ = label.partition(".")
        if dot and effects[effect].amplitudes:
            others = effects[effect].amplitudes + (() if smooth else effects[effect].smooth)
            out[j] = own_name(label) not in others
    return out


def at_bounds(regression: Regression) -> NDArray[np.bool_]:
    """Parameters that stand at a bound (k,)."""
    v = regression.vector
    margin = _AT_BOUND * v.scale
    return np.asarray((regression.theta <= v.low + margin) | (regression.theta >= v.high - margin))


def bent_shape(regression: Regression, name: str) -> str:
    """Label of a shape of an effect that stands at the end of what the data tell from another law; empty if none.

    A friction that is developed only beyond the speeds of the data is no dry one, whatever explains the data; and a
    force that repeats less than once in a turn does not repeat.
    """
    v = regression.vector
    (effect,) = (e for e in v.system.effects if isinstance(e, Effect) and e.name == name)
    low, high = (
        regression.theta <= v.low + _AT_BOUND * v.scale,
        regression.theta >= v.high - _AT_BOUND * v.scale,
    )

    def bent(j: int) -> bool:
        own = own_name(v.labels[j])
        return bool(
            high[j] if own in effect.relative else low[j] and own in effect.shapes and isinstance(effect, Law)
        )

    return next((v.labels[j] for j in v.of(name) if bent(j)), "")


def carried(vector: ParameterVector, before: Regression) -> Array:
    """First values: those of a regression where it has the parameter, else the system's."""
    known = dict(zip(before.vector.labels, before.theta.tolist(), strict=True))
    return np.array(
        [known.get(label, v) for label, v in zip(vector.labels, vector.start.tolist(), strict=True)]
    )


def without_effect(system: System, declared: System, name: str) -> System:
    """The system without an effect that was added; a declared one that it stood in for is back."""
    left = system.without_effects(name)
    contained = effect_class(name).includes
    back = [e for e in declared.effects if e.name in contained and e.name not in left.effect_names]
    return left.with_effects(*back) if back else left  # type: ignore[arg-type]
