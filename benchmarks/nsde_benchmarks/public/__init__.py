"""Public measured sets by their own protocol, beside what others reached on them.

The data stay where they are: the user fetches a repository, and `run_benchmark` reads its files as they are.
"""

from typing import TYPE_CHECKING

from nsde_torch.lazy import resolver

if TYPE_CHECKING:
    from nsde_benchmarks.public.benchmark import (
        BenchmarkMetric,
        BenchmarkOutcome,
        PublicBenchmark,
        PublishedRow,
        Trace,
    )
    from nsde_benchmarks.public.running import BENCHMARKS, run_benchmark

__all__ = [
    "BENCHMARKS",
    "BenchmarkMetric",
    "BenchmarkOutcome",
    "PublicBenchmark",
    "PublishedRow",
    "Trace",
    "run_benchmark",
]

# the command line reads the names of the sets, and is to load nothing heavy for it
__getattr__ = resolver(__name__)
