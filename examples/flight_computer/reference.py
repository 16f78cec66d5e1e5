"""Writes a reference of `nsde track` as the CSV file that flight_computer reads: python reference.py circle out.csv."""

from __future__ import annotations

import argparse
import csv

import torch

from nsde_torch.control import shapes
from nsde_torch.control.reference import Reference
from nsde_torch.systems.multirotor import Multirotor

SHAPES = {"circle": shapes.circle, "lemniscate": shapes.lemniscate, "hover": shapes.hover}


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shape", choices=SHAPES)
    parser.add_argument("out")
    given = parser.parse_args()
    path = Reference(SHAPES[given.shape]())
    times = path.dt * torch.arange(round(path.duration / path.dt) + 1, dtype=torch.float64)
    with open(given.out, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["t", *Multirotor.state_names])
        writer.writerows([t, *row] for t, row in zip(times.tolist(), path.at(times).tolist(), strict=True))


if __name__ == "__main__":
    main()
