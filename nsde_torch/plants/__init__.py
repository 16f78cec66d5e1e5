"""Plants: simulated machines that stand for the real ones, and the data sets made with them."""

from typing import TYPE_CHECKING

from nsde_torch.lazy import resolver

if TYPE_CHECKING:
    from nsde_torch.plants.cartpole import SwingUp, cartpole_episodes
    from nsde_torch.plants.cascade import Cascade, Gains
    from nsde_torch.plants.excitation import excited_runs
    from nsde_torch.plants.flights import manual_flights
    from nsde_torch.plants.machines import MACHINES, Machine, Making, make_plant, make_plant_system
    from nsde_torch.plants.mass_spring_damper import spring_runs
    from nsde_torch.plants.noise import Gust
    from nsde_torch.plants.options import RecordingOptions, ReplayOptions
    from nsde_torch.plants.plant import Plant
    from nsde_torch.plants.recorder import record
    from nsde_torch.plants.recording import Recording
    from nsde_torch.plants.registry import simulated
    from nsde_torch.plants.replay import Replay
    from nsde_torch.plants.simulation import Simulation, simulate, write

__all__ = [
    "MACHINES",
    "Cascade",
    "Gains",
    "Gust",
    "Machine",
    "Making",
    "Plant",
    "Recording",
    "RecordingOptions",
    "Replay",
    "ReplayOptions",
    "Simulation",
    "SwingUp",
    "cartpole_episodes",
    "excited_runs",
    "make_plant",
    "make_plant_system",
    "manual_flights",
    "record",
    "simulate",
    "simulated",
    "spring_runs",
    "write",
]

__getattr__ = resolver(
    __name__,
    {
        "MACHINES": "machines",
        "Cascade": "cascade",
        "Gains": "cascade",
        "Gust": "noise",
        "Machine": "machines",
        "Making": "machines",
        "Plant": "plant",
        "Recording": "recording",
        "RecordingOptions": "options",
        "Replay": "replay",
        "ReplayOptions": "options",
        "Simulation": "simulation",
        "SwingUp": "cartpole",
        "cartpole_episodes": "cartpole",
        "excited_runs": "excitation",
        "make_plant": "machines",
        "make_plant_system": "machines",
        "manual_flights": "flights",
        "record": "recorder",
        "simulate": "simulation",
        "simulated": "registry",
        "spring_runs": "mass_spring_damper",
        "write": "simulation",
    },
)
