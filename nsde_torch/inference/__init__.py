"""One likelihood of physics, disturbances and sensors: the prediction errors of the SDE itself.

    dx = (f(x, u; theta) + B (d + w)) dt,      d Ornstein-Uhlenbeck, w white, on the ports;      y = some of x + noise

An extended Kalman filter predicts every row from those before it. Its innovations e_k, with the covariances S_k that it
gives them, are the likelihood of a log (prediction error decomposition: Schweppe, IEEE Transactions on Information
Theory 11 (1965); Ljung, System Identification, 1999, chapter 7):

    log p(y | theta, noise) = - 1/2 sum_k (e_k' S_k^-1 e_k + log det 2 pi S_k)

    steps         runs as steps, and these as chunks that overlap: a few hundred in sequence do for a log of any length
    state_space   the machine as this filter sees it: a step, its linearisation, what parameters do to it
    levels        sizes of the noise of sensors and disturbances, with the first guess
    filtering     one pass: innovations, gains, log likelihood
    maximum       noise levels of largest likelihood, by Fisher scoring
    sensitivity   what parameters do to the innovations, as one Gram matrix per block of time
    force_scores  what the likelihood says of any force on the ports, by one pass backwards
    left_out      parts of a log as they are predicted by parameters that were fitted to the rest
    posterior     theta at given noise levels with a prior: hundreds of short logs side by side
    estimate      theta and noise levels of largest likelihood, whether its innovations are white; states at some values
"""

from nsde_torch.inference.estimate import (
    LogLikelihood,
    MaximumLikelihood,
    Optimum,
    fit,
    log_likelihood,
    maximised,
    nearly_maximised,
)

__all__ = [
    "LogLikelihood",
    "MaximumLikelihood",
    "Optimum",
    "fit",
    "log_likelihood",
    "maximised",
    "nearly_maximised",
]
