"""How one channel of a residual depends on one variable: the result of a specification test."""

from dataclasses import dataclass

from nsde_torch.sysid.noise import Noise


@dataclass(frozen=True)
class Dependence:
    """How one channel depends on one variable.

    Args:
        channel: Name of the channel.
        variable: Name of the variable ("time", "run" and "x * y" too).
        p: Chance of this without any dependence, not corrected for the number of tests.
        share: Share of the whitened variance that the functions explain, corrected for their number.
        odd: Share of that by odd functions, the rest by even ones.
        gain: Log-likelihood that the functions would bring [nats].
        functions: Number of functions.
        run: Number of the run, of a test of one run alone or of a single moment.
        moment: Time of a single moment [s].
        sinusoid: Frequency of a sinusoid that no phase holds together [Hz].
        noise: ARMA noise model without the functions; None: that of the regression.
    """

    channel: str
    variable: str
    p: float
    share: float
    odd: float
    gain: float
    functions: int
    run: int | None = None
    moment: float | None = None
    sinusoid: float | None = None
    noise: Noise | None = None

    @property
    def excess(self) -> float:
        """Nats beyond what as many functions bring in noise, half a nat each."""
        return self.gain - 0.5 * self.functions

    @property
    def everywhere(self) -> bool:
        """Whether it is one of functions that are the same in all runs."""
        return self.run is None and self.sinusoid is None
