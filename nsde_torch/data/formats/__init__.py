"""Files of logs as streams: a function of each format opens one file as a `StreamLog`, and knows nothing of machines.

What the streams mean to a machine is the business of `nsde_torch.data.mapping`. A file that cannot be read, or holds no
streams, is a DataError; an optional package that is not installed a ConfigError.
"""

from nsde_torch.data.streams import StreamLog

__all__ = ["StreamLog"]
