"""Public measured sets by their own protocol, beside what others reached on them.

The data stay where they are: the user fetches a repository, and `run_benchmark` reads its files as they are.
"""

from nsde_torch.public_benchmarks.benchmark import (
    BenchmarkMetric,
    BenchmarkOutcome,
    PublicBenchmark,
    PublishedRow,
    Trace,
)
from nsde_torch.public_benchmarks.registry import BENCHMARKS
from nsde_torch.public_benchmarks.running import run_benchmark

__all__ = [
    "BENCHMARKS",
    "BenchmarkMetric",
    "BenchmarkOutcome",
    "PublicBenchmark",
    "PublishedRow",
    "Trace",
    "run_benchmark",
]
