"""What a candidate would explain by one linearised step from its start: the likelihood ratio, and standard errors."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from nsde_torch.diagnosis.candidates import Start, make_candidate
from nsde_torch.diagnosis.fitted import carried, values_of
from nsde_torch.diagnosis.search import Base, Search
from nsde_torch.effects import Effect, effect_class
from nsde_torch.errors import NonFiniteError, NsdeError
from nsde_torch.sysid.physics import Physics
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems import System
from nsde_torch.systems.parameters import ParameterVector, own_name

Array = NDArray[np.float64]

_UNMOVED = 1e-6  # standard deviations of the noise: a start that moves no row by more changes nothing


def starts(
    system: System, name: str, scales: Mapping[str, float], frequencies: Sequence[float]
) -> list[Start]:
    """Values that fits of a candidate start from.

    What it contains and is there lends it the shapes that both have, and a start at which it is that effect: from there
    it explains no less.
    """
    cls = effect_class(name)
    found = cls.starts(scales, frequencies)
    for effect in system.effects:
        assert isinstance(effect, Effect)
        if effect.name not in cls.includes:
            continue
        theirs = values_of(effect)
        alike = {own: theirs[key] for own, key in cls.shared(type(effect)).items()}
        lent = {own: value for own, value in alike.items() if own in cls.shapes}
        for start in [{**start, **more} for more in (lent, alike) for start in found]:
            found += [] if start in found else [start]
    return found


def joined(system: System, name: str, start: Start) -> System:
    """The system with a candidate, without what the candidate contains."""
    contained = set(effect_class(name).includes) & set(system.effect_names)
    if contained:
        system = system.without_effects(*contained)
    return system.with_effects(make_candidate(name, system, start))


def likeliest(search: Search, base: Base, systems: Sequence[System], most: int) -> list[System]:
    """The systems to screen: of those whose start already moves the residual, some that explain most.

    All of them where the candidate stands in for an effect of the physics: another start may lead further from there.

    Args:
        search: Data and settings.
        base: Physics without the candidate.
        systems: Physics with it, at each of its starts.
        most: How many of those that move the residual are kept.
    """
    beside = all(set(base.system.effect_names) < set(system.effect_names) for system in systems)
    if len(systems) <= most or not beside:
        return list(systems)
    before = base.regression
    whole = before.white.reshape(-1)
    left: dict[int, float] = {}
    for i, system in enumerate(systems):
        vector = ParameterVector(system)
        theta = vector.inside(carried(vector, before))
        try:
            residual = _whitened_residual(search, before, Physics(vector, search.steps), theta)
        except NsdeError:  # screening it will tell
            continue
        if residual is not None and not np.allclose(residual, whole, rtol=0.0, atol=_UNMOVED):
            along = base.span.T @ residual
            left[i] = float(residual @ residual - along @ along)
    kept = sorted(left, key=lambda i: left[i])[:most]
    return [system for i, system in enumerate(systems) if i in kept or i not in left]


def screen(
    search: Search, base: Base, system: System, name: str, held: Sequence[str]
) -> tuple[float, dict[str, float]]:
    """Log-likelihood difference [nats] of one linearised step from the start of a candidate; standard errors."""
    before = base.regression
    vector = ParameterVector(system)
    physics = Physics(vector, search.steps)
    theta = vector.inside(carried(vector, before))
    cls = effect_class(name)
    mine = vector.of(name)
    moved = [j for j in mine if own_name(vector.labels[j]) in cls.amplitudes and vector.labels[j] not in held]
    beside = len(vector) == len(before.vector) + len(mine)
    whole = before.white.reshape(-1)
    residual = whole
    if beside and moved and not vector.moves_memory[moved].any():
        physics.foresee_like(before.physics, theta, before.theta)
        new, columns = whitened_slopes(search, before, physics.slopes(theta, moved)), moved
    else:
        moved_residual = _whitened_residual(search, before, physics, theta)
        if moved_residual is None:
            raise NonFiniteError(f"{name} is not finite at its start.")
        residual = moved_residual
        columns = [j for j in range(len(vector)) if vector.labels[j] not in {*held, *search.held}]
        new = whitened_slopes(search, before, physics.slopes(theta))[:, columns]
    basis = base.span
    before_left = whole - basis @ (basis.T @ whole)
    if beside:
        residual = residual - basis @ (basis.T @ residual)
        new = new - basis @ (basis.T @ new)
    size = np.linalg.norm(new, axis=0)
    new = new / np.maximum(size, 1e-300)
    rest = residual - new @ np.linalg.lstsq(new, residual, rcond=1e-6)[0]
    sizes = cls.amplitudes or cls.null
    live = [i for i, j in enumerate(columns) if j in mine and own_name(vector.labels[j]) in sizes]
    live = live if beside else []  # what the others could do instead was not taken out
    labels = [vector.labels[columns[i]] for i in live]
    errors = dict(zip(labels, standard_errors(new, size, live), strict=True))
    return 0.5 * float(before_left @ before_left - rest @ rest), errors


def _whitened_residual(search: Search, before: Regression, physics: Physics, theta: Array) -> Array | None:
    """Residual of physics in whitened rows (channels * N,); None where it is not finite."""
    left = before.single.summed(physics.residual(theta), search.box)
    if not np.isfinite(left[:, before.rows]).all():
        return None
    pairs = zip(before.noises, before.rows, strict=True)
    return np.stack([before.whitened(n, left[:, [c]])[:, 0] for n, c in pairs]).reshape(-1)


def whitened_slopes(search: Search, before: Regression, slopes: Array) -> Array:
    """Slopes over steps as whitened columns (rows * N, q)."""
    summed = before.single.summed(slopes, search.box)
    pairs = zip(before.noises, before.rows, strict=True)
    return np.concatenate([before.whitened(n, summed[:, c]) for n, c in pairs])


def standard_errors(columns: Array, size: Array, which: Sequence[int]) -> list[float]:
    """Standard errors of some coefficients beside each other, under noise of variance 1.

    Args:
        columns: Columns (N, q) of length 1, or of length 0.
        size: What they were divided by (q,).
        which: Numbers of the coefficients; others than these are not free.

    Returns:
        One per coefficient, infinite where its column is nothing beside the others.
    """
    part = columns[:, which]
    inverse = np.linalg.pinv(part.T @ part, rcond=1e-9)
    gone = 1.0 - np.diag(inverse @ (part.T @ part)) > 1e-6
    dead = gone | (size[which] <= 1e-9 * max(float(size.max(initial=0.0)), 1e-300))
    error = np.sqrt(np.clip(np.diag(inverse), 0.0, None)) / np.maximum(size[which], 1e-300)
    return np.where(dead, np.inf, error).tolist()
