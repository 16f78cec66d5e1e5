"""Inputs of an open loop: pieces of equal length, each a hold, ramp, sine, chirp, square wave or two sines.

    u(t) = middle + half range * clip(offset + amplitude * wave(t), -1, 1)

Each piece of each input has six genes in [0, 1]: kind, offset, amplitude, two frequencies (on a logarithmic scale) and
a phase. They are few, a person can fly them, and a search can change one at a time. Offset and amplitude are on a scale
that is fine about rest, value = sinh(5 g) / sinh(5): what a machine does may hang on forces that are a hundredth of
those that its runs held, a dry friction for one.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.design.limits import ExperimentLimits

KINDS = ("hold", "ramp", "sine", "chirp", "square", "two sines")
PIECES = 4
GENES = 6
SCALES = (1.0, 0.5, 0.25, 0.1)
"""Shares of the range of the inputs that a baseline is tried at."""
_FINE = 5.0
_SMALLEST = 0.1


@dataclass(frozen=True)
class Signals:
    """Inputs of one length within limits."""

    limits: ExperimentLimits
    dt: float
    steps: int
    hertz: tuple[float, float]  # lowest and highest frequency [Hz]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of the genes of an experiment: pieces, inputs, genes."""
        return PIECES, len(self.limits.low), GENES

    def random(self, count: int, rng: np.random.Generator) -> Array:
        """Genes (count, pieces, nu, 6)."""
        genes = rng.uniform(0.0, 1.0, (count, *self.shape))
        same = rng.uniform(size=count) < 0.4  # one wave throughout
        genes[same, 1:] = genes[same, :1]
        size = rng.uniform(_SMALLEST, 1.0, count)[:, None, None]  # of the whole experiment
        genes[..., 1] = 0.5 + (genes[..., 1] - 0.5) * size * rng.choice([0.0, 0.3, 1.0], count)[:, None, None]
        genes[..., 2] *= size
        return genes

    def gentle(self, count: int, rng: np.random.Generator) -> Array:
        """Genes of inputs of small swing about where the machine is left alone (count, pieces, nu, 6)."""
        genes = self.random(count, rng)
        genes[..., 1] = 0.5 + 0.02 * (genes[..., 1] - 0.5)
        genes[..., 2] *= np.linspace(0.03, 0.5, count)[:, None, None]
        return np.clip(genes, 0.0, 1.0 - 1e-9)

    def mutated(self, genes: Array, rng: np.random.Generator) -> Array:
        """Genes near others (count, pieces, nu, 6)."""
        out = genes.copy()
        for g in out:
            size = rng.choice([0.03, 0.1, 0.3])
            chosen = rng.uniform(size=g.shape) < rng.choice([0.1, 0.3, 1.0])
            g += size * chosen * rng.standard_normal(g.shape)
            if rng.uniform() < 0.25:  # one piece as another
                a, b = rng.integers(len(g), size=2)
                g[a] = g[b]
            if rng.uniform() < 0.2:
                g[rng.integers(len(g)), :, 0] = rng.uniform()
        return np.clip(out, 0.0, 1.0 - 1e-9)

    def shrunk(self, genes: Array, shares: Array) -> Array:
        """Genes of the same inputs with shares (count,) of their distance from rest (count, pieces, nu, 6)."""
        out, share = genes.copy(), shares[:, None, None]
        out[..., 1] = 0.5 + 0.5 * _gene(share * _fine(2.0 * genes[..., 1] - 1.0))
        out[..., 2] = _gene(share * _fine(genes[..., 2]))
        return out

    def inputs(self, genes: Array) -> Array:
        """Inputs (count, steps, nu) of genes (count, pieces, nu, 6)."""
        t = self.dt * np.arange(self.steps, dtype=np.float64)
        edges = np.linspace(0, self.steps, PIECES + 1).round().astype(int)
        out = np.empty((len(genes), self.steps, genes.shape[2]))
        for p, (a, b) in enumerate(pairwise(edges.tolist())):
            out[:, a:b] = np.moveaxis(self._piece(genes[:, p], t[a:b]), 2, 1)
        return self._scaled(out)

    def words(self, genes: Array) -> list[str]:
        """What a person reads of the genes (pieces, nu, 6) of one experiment."""
        edges = self.dt * np.linspace(0, self.steps, PIECES + 1).round()
        out = []
        half, middle, (low, high) = self._half, self._middle, np.log(self.hertz)
        for p, (a, b) in enumerate(pairwise(edges.tolist())):
            for i, name in enumerate(self.limits.inputs):
                g = genes[p, i]
                f1, f2 = np.exp(low + g[3:5] * (high - low))
                offset = self._offset(genes[p, :, 1])[i]
                about, swing = middle[i] + half[i] * offset, half[i] * float(_fine(g[2]))
                told = {
                    "hold": f"hold {about:.3g}",
                    "ramp": f"ramp from {about - swing:.3g} to {about + swing:.3g}",
                    "sine": f"sine of {f1:.2g} Hz, +- {swing:.3g} about {about:.3g}",
                    "chirp": f"chirp from {f1:.2g} to {f2:.2g} Hz, +- {swing:.3g} about {about:.3g}",
                    "square": f"to and fro at {f1:.2g} Hz, +- {swing:.3g} about {about:.3g}",
                    "two sines": f"sines of {f1:.2g} and {f2:.2g} Hz, +- {swing:.3g} about {about:.3g}",
                }[KINDS[int(g[0] * len(KINDS))]]
                out.append(f"{a:.4g} to {b:.4g} s: {name} {told}")
        return out

    def baselines(
        self, rng: np.random.Generator, before: Array | None = None
    ) -> dict[str, tuple[Array, tuple[str, ...]]]:
        """Usual inputs (scales, steps, nu), with words; `before` are inputs (n, nu) of a run there is, given again."""
        t = self.dt * np.arange(self.steps, dtype=np.float64)
        n = len(self.limits.low)
        low, high = self.hertz
        top = min(high, max(2.0, 4.0 * low))
        f = np.exp(rng.uniform(np.log(low), np.log(top), (n, 8)))
        sines = np.sin(2 * np.pi * f[..., None] * t + rng.uniform(0, 2 * np.pi, (n, 8, 1))).sum(1)
        rate = np.log(high / low) / t[-1]
        chirp = np.sin(2 * np.pi * low * np.expm1(rate * t) / rate)
        period = 4.0 * max(0.5, 2.0 * self.dt)
        place = np.mod(t, period) / period
        doublet = np.where(place < 0.25, 1.0, np.where(place < 0.5, -1.0, 0.0))
        sines /= np.abs(sines).max(1, keepdims=True)
        waves = {
            "multisine": (sines, f"8 sines of random phase, {low:.2g} to {top:.2g} Hz"),
            "chirp": (np.tile(chirp, (n, 1)), f"a chirp from {low:.2g} to {high:.2g} Hz"),
            "doublets": (np.tile(doublet, (n, 1)), f"a doublet of {period:.2g} s, again and again"),
        }
        sizes = np.array(SCALES)[:, None, None]
        out: dict[str, tuple[Array, tuple[str, ...]]] = {
            name: (self._scaled(sizes * wave.T[None]), (told,)) for name, (wave, told) in waves.items()
        }
        if before is not None:
            again = before[np.arange(self.steps) % len(before)]
            table = np.clip(sizes * again, self.limits.low, self.limits.high)
            out["the longest run again"] = table, ("the inputs of the longest run",)
        return out

    def _scaled(self, unit: Array) -> Array:
        return np.asarray(self._middle + self._half * np.clip(unit, -1.0, 1.0))

    @property
    def _half(self) -> Array:
        return np.asarray(0.5 * (self.limits.high - self.limits.low))

    @property
    def _middle(self) -> Array:
        return np.asarray(0.5 * (self.limits.high + self.limits.low))

    @property
    def _rest(self) -> Array:
        """Input 0, or the nearest to it, in [-1, 1]."""
        return np.clip(-self._middle / self._half, -1.0, 1.0)

    def _offset(self, gene: Array) -> Array:
        """Offsets in [-1, 1] of genes (..., nu): 0.5 is rest, 0 and 1 are the ends of the range."""
        away = _fine(2.0 * gene - 1.0)
        return np.asarray(self._rest + away * np.where(away < 0, 1.0 + self._rest, 1.0 - self._rest))

    def _piece(self, g: Array, t: Array) -> Array:
        """Unit inputs (count, nu, n) of the genes (count, nu, 6) of one piece at times (n,)."""
        low, high = np.log(self.hertz)
        f1, f2 = (np.exp(low + g[..., k, None] * (high - low)) for k in (3, 4))
        phase = 2 * np.pi * g[..., 5, None]
        s = (t - t[0]) / max(t[-1] - t[0], self.dt)
        length = max(t[-1] - t[0], self.dt)
        one = np.sin(2 * np.pi * f1 * t + phase)
        ratio = np.log(f2 / f1)
        ratio = np.where(np.abs(ratio) < 1e-6, 1e-6, ratio)
        waves = np.stack(
            [
                np.zeros_like(one),
                np.broadcast_to(2.0 * s - 1.0, one.shape),
                one,
                np.sin(2 * np.pi * f1 * length * np.expm1(ratio * s) / ratio + phase),
                np.where(one >= 0, 1.0, -1.0),
                0.5 * (one + np.sin(2 * np.pi * f2 * t)),
            ]
        )
        kind = (g[..., 0] * len(KINDS)).astype(int)
        wave = np.take_along_axis(waves, kind[None, ..., None], 0)[0]
        return np.asarray(self._offset(g[..., 1])[..., None] + _fine(g[..., 2, None]) * wave)


def _fine(gene: Array) -> Array:
    """Values in [-1, 1] of genes in [-1, 1], with the more room the nearer to 0."""
    return np.asarray(np.sinh(_FINE * gene) / np.sinh(_FINE))


def _gene(value: Array) -> Array:
    """Genes in [-1, 1] of values in [-1, 1]."""
    return np.asarray(np.arcsinh(value * np.sinh(_FINE)) / _FINE)
