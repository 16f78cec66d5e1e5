"""Innovations: what is new at each step of the log, given everything before it.

In a closed loop the inputs between t and t + h answer the disturbances between t and t + h, so the error of a
prediction over h under the log's own inputs is not that of the same inputs set by hand, and a loss over it learns the
controller. An innovation is free of this: input and state at step k are known before it (Ljung, System Identification,
1999, sections 7.2 and 13.4).
"""

__all__: list[str] = []
