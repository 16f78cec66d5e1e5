"""How one channel of a residual depends on one variable: the result of a specification test."""

from dataclasses import dataclass

from nsde_torch.sysid.noise import Noise


@dataclass(frozen=True)
class Dependence:
    """How one channel depends on one variable."""

    channel: str  # name of the channel
    variable: str  # name of the variable ("time", "run" and "x * y" too)
    p: float  # chance of this without any dependence, not corrected for the number of tests
    share: float  # share of the whitened variance that the functions explain, corrected for their number
    odd: float  # share of that by odd functions, the rest by even ones
    gain: float  # log-likelihood that the functions would bring [nats]
    functions: int  # number of functions
    run: int | None = None  # number of the run, of a test of one run alone or of a single moment
    moment: float | None = None  # time of a single moment [s]
    sinusoid: float | None = None  # frequency of a sinusoid that no phase holds together [Hz]
    noise: Noise | None = None  # ARMA noise model without the functions; None: that of the regression

    @property
    def excess(self) -> float:
        """Nats beyond what as many functions bring in noise, half a nat each."""
        return self.gain - 0.5 * self.functions

    @property
    def everywhere(self) -> bool:
        """Whether it is one of functions that are the same in all runs."""
        return self.run is None and self.sinusoid is None
