"""The public sets: a file each, and a line here. Listing them imports none."""

BENCHMARK_HOMES: dict[str, str] = {
    "emps": "nsde_benchmarks.public.emps:Emps",
    "silverbox": "nsde_benchmarks.public.silverbox:Silverbox",
    "nanodrone": "nsde_benchmarks.public.nanodrone:Nanodrone",
    "nanobench": "nsde_benchmarks.public.nanobench:NanoBench",
    "pendulum": "nsde_benchmarks.public.pendulum:TorqueLimitedPendulum",
    "bam": "nsde_benchmarks.public.bam:Bam",
    "boucwen": "nsde_benchmarks.public.boucwen:BoucWen",
}
"""Name of a set -> `module:Class`."""
