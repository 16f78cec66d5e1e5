"""Public benchmarks and the paper's figures, as plug-ins of `nsde`: the library does not import this package.

Its commands, `nsde benchmark` and `nsde figures`, are entry points of the group `nsde_torch.commands`.
"""
