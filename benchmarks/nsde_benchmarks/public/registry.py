"""The public sets by name."""

from nsde_torch.lookup import class_by_name

from .benchmark import PublicBenchmark
from .names import BENCHMARK_HOMES

BENCHMARKS: dict[str, type[PublicBenchmark]] = {
    name: class_by_name(home, {}, PublicBenchmark, kind="benchmark", home="nsde_benchmarks.public.benchmark")
    for name, home in BENCHMARK_HOMES.items()
}


def benchmark_class(name: str) -> type[PublicBenchmark]:
    """Class of a set: a key of `BENCHMARKS`, or `package.module:Class` of the user's own.

    Raises:
        ConfigError: unknown name (lists the choices), no such module or class, or not a PublicBenchmark.
    """
    return class_by_name(
        name, BENCHMARKS, PublicBenchmark, kind="benchmark", home="nsde_benchmarks.public.benchmark"
    )
