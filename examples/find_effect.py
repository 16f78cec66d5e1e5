"""From a folder of CSV files to a named effect, and to a model that has it.

python find_effect.py logs/ hexacopter
"""

import sys

import nsde_torch

folder, system = sys.argv[1:]
found = nsde_torch.diagnose(folder, system=system).finished()
print(found)
found.save("diagnosis")
model = nsde_torch.train(folder, system=system, effects=found.effects, trainer="fast", run_dir="model")
print(nsde_torch.evaluate(model, folder, runs=model.metrics["test_runs"]))
