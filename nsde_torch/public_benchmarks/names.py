"""The public sets: a file each, and a line here. Listing them imports none."""

BENCHMARK_HOMES: dict[str, str] = {
    "emps": "nsde_torch.public_benchmarks.emps:Emps",
    "silverbox": "nsde_torch.public_benchmarks.silverbox:Silverbox",
    "nanodrone": "nsde_torch.public_benchmarks.nanodrone:Nanodrone",
    "nanobench": "nsde_torch.public_benchmarks.nanobench:NanoBench",
    "pendulum": "nsde_torch.public_benchmarks.pendulum:TorqueLimitedPendulum",
    "bam": "nsde_torch.public_benchmarks.bam:Bam",
    "boucwen": "nsde_torch.public_benchmarks.boucwen:BoucWen",
}
"""Name of a set -> `module:Class`."""
