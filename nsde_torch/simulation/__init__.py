"""Simulation: plants, which are simulated machines in place of the real ones, and the data sets made with them."""

from typing import TYPE_CHECKING

from nsde_torch.lazy import names, resolver

if TYPE_CHECKING:
    from nsde_torch.simulation.cartpole import SwingUp, cartpole_episodes
    from nsde_torch.simulation.excitation import excited_runs, spring_runs
    from nsde_torch.simulation.flights import manual_flights
    from nsde_torch.simulation.generate import Simulation, simulate, write
    from nsde_torch.simulation.make import Making, make_plant, record
    from nsde_torch.simulation.options import Replay
    from nsde_torch.simulation.plant import LearnedPlant, Plant
    from nsde_torch.simulation.registry import simulated

__all__ = names(__name__)

__getattr__ = resolver(__name__)
