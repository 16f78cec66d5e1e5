"""The commands, a file each (see `nsde_torch.cli.registry`)."""
