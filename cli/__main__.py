"""`python -m nsde_torch.cli` is `nsde`."""

from .main import entry

entry()
