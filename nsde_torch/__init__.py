"""Learn a controlled stochastic model of a machine from minutes of data, and know where it is ignorant.

Five verbs, each what the command of the same name does:

    found = nsde_torch.diagnose("logs/", system="hexacopter")   what the declared physics lacks
    model = nsde_torch.train("logs/", system="hexacopter", effects=found.effects)   a model with it
    scores = nsde_torch.evaluate(model, "more_logs/")           its errors and intervals
    made = nsde_torch.simulate("hexacopter", seed=0)            runs of a simulated machine
    model = nsde_torch.load("runs/hexacopter")                  a model that was trained before

`nsde_torch.inspect("log")` says what is in a log of any format, and what its columns mean.
`System` and `Effect` are what a machine and a physical term of your own derive from.
"""

from typing import TYPE_CHECKING

from nsde_torch.lazy import names, resolver

if TYPE_CHECKING:
    from nsde_torch.api.diagnosing import diagnose
    from nsde_torch.api.evaluation import evaluate
    from nsde_torch.api.inspecting import inspect
    from nsde_torch.api.reading import read
    from nsde_torch.api.training import train
    from nsde_torch.design.diagnosis_rehearsal import rehearse
    from nsde_torch.effects.base import Effect
    from nsde_torch.models.neural_sde import NeuralSDE
    from nsde_torch.models.run_directory import load
    from nsde_torch.simulation.generate import simulate
    from nsde_torch.systems.base import System

__version__ = "0.1.0"
__all__ = ["__version__", *names(__name__)]

__getattr__ = resolver(__name__)
