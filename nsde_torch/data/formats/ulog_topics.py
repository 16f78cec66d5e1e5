"""All topics of a PX4 log as streams, to look at; `nsde_torch.data.ulog` reads what a multirotor needs by itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nsde_torch.data.formats.log import StreamLog, unreadable
from nsde_torch.data.streams import Stream, ordered


def open_ulog(path: Path) -> StreamLog:
    """The topics of one log.

    Raises:
        DataError: not such a log.
    """
    from pyulog import ULog

    try:
        with path.open("rb") as file:
            data = ULog(file).data_list
    except Exception as error:  # a damaged log makes the parser raise nearly anything
        raise unreadable(path, "ULog file", error) from error
    streams = []
    for topic in sorted(data, key=lambda one: (one.name, int(one.multi_id))):
        fields = {name: np.asarray(values, dtype=np.float64) for name, values in topic.data.items()}
        t = fields.pop("timestamp") * 1e-6
        name = topic.name if not topic.multi_id else f"{topic.name}[{topic.multi_id}]"
        if len(t) > 1:
            streams.append(ordered(Stream(name, t, fields)))
    return StreamLog(path.stem, str(path), streams, {}, {"world": "NED", "body": "FRD"})
