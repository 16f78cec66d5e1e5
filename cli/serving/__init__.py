"""What `nsde serve` serves: a page on this machine that takes logs and gives their diagnosis.

The server reads no log and does no computation. Each job is a command of `nsde` in a process of its own, with limits,
in a folder of its own; the page shows what these commands say and write.
"""
