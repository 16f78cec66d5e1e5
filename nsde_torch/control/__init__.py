"""Model predictive control: plans, solvers, references and closed loops."""

from typing import TYPE_CHECKING

from nsde_torch.lazy import names, resolver

if TYPE_CHECKING:
    from nsde_torch.control.autopilots import Autopilot, CascadePilot, PredictivePilot
    from nsde_torch.control.cascade import Cascade
    from nsde_torch.control.controller import Controller, Plan, Planner
    from nsde_torch.control.loop import Flight, SteppedMachine, fly
    from nsde_torch.control.options import EstimatorOptions, ProblemOptions, SafetyOptions, SolverOptions
    from nsde_torch.control.predictor import Predictor
    from nsde_torch.control.problem import problem_of
    from nsde_torch.control.reference import FlightPath, Reference, StateReference, course, setpoint
    from nsde_torch.control.shapes import circle, lemniscate
    from nsde_torch.control.solve import Solution, Solver

__all__ = names(__name__)
__getattr__ = resolver(__name__)
