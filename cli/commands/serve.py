"""`nsde serve`: open a page on this machine that takes dropped logs and gives their diagnosis."""

from __future__ import annotations

import secrets
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nsde_torch.errors import ConfigError

from ..hydra_command import Config, HydraCommand, Job
from ..keys import group, key
from ..schemas import SystemConfig

HOST = "127.0.0.1"  # the page is for who sits at this machine: no other address is ever bound
_THREADS = 8  # requests at a time
_SPARE = 1 << 20  # bytes of a request beside its logs


@dataclass
class ServeConfig:
    port: int = key(8765, "port on 127.0.0.1; 0: any that is free", low=0, high=65535)
    out_dir: str = key("served", "folder that keeps the logs and what was found in them", file=True)
    upload: float = key(512.0, "largest upload of one diagnosis, all its logs together", unit="MiB", above=0)
    max_minutes: float = key(
        10.0, "time after which a diagnosis ends with what is known", unit="min", above=0
    )
    time: float = key(3600.0, "time after which a diagnosis is killed, without a result", unit="s", above=0)
    memory: float = key(8.0, "largest memory of one diagnosis", unit="GiB", above=0)
    jobs: int = key(1, "diagnoses at a time; further ones wait", low=1)
    keep: int = key(50, "most diagnoses that are kept: then one has to be deleted", low=1)
    system: SystemConfig = group(
        SystemConfig,
        "machine that the page chooses at first, with what is known of it; null: chosen by what is logged",
    )


COMMAND = HydraCommand(
    name="serve",
    schema=ServeConfig,
    groups={"system": None},
    values={"system": {"name": "chosen from what is logged"}},
    examples=(
        ("", "print the address of the page; Ctrl-C ends it"),
        ("system=hexacopter", "for logs of this machine"),
        ("out_dir=diagnoses", "keep logs and results in this folder"),
        ("--config-dir my_machines", "with machines of your own"),
    ),
)


def run(config: Config, job: Job) -> None:
    """Serve until Ctrl-C; ConfigError where a package, the port or the machine is not there."""
    from hydra.core.hydra_config import HydraConfig

    from ..own_modules import config_folders

    try:
        from ..serving.app import ServedPage, listen, serve
    except ModuleNotFoundError as error:
        package = str(error.name).partition(".")[0]
        raise ConfigError(
            f"`nsde serve` needs the package {package!r}, which is not installed: pip install 'nsde_torch[serve]'."
        ) from error
    from ..serving.job import ServeLimits, Shelf, machines
    from ..serving.runner import JobRunner

    typed = HydraConfig.get()
    own = config_folders(typed.runtime.config_sources)
    system = typed.runtime.choices.get("system")
    known = machines(
        Path(own[0]) if own else None,
        first=system,
        typed=[word for word in typed.overrides.task if word.lstrip("+~").startswith("system.")],
    )
    bytes_ = {"upload": int(config.upload * 2**20), "memory": int(config.memory * 2**30)}
    same = {name: config[name] for name in ("max_minutes", "jobs", "keep")}
    limits = ServeLimits(**bytes_, seconds=config.time, **same)
    sock = listen(HOST, config.port)
    port = sock.getsockname()[1]
    token = secrets.token_urlsafe(24)
    shelf = Shelf(Path(config.out_dir), limits)
    runner = JobRunner(shelf, known)
    hosts = [f"{name}:{port}" for name in (HOST, "localhost")]
    page: Any = ServedPage(runner, token=token, hosts=hosts)
    print(f"http://{HOST}:{port}/#{token}", flush=True)
    print(
        f"Open this address in a browser of this machine. Logs and results are kept in {shelf.folder}; Ctrl-C ends it.",
        flush=True,
    )
    try:
        serve(sock, page, token=token, largest=limits.upload + _SPARE, threads=_THREADS)
    finally:
        runner.close()
    print(f"\nnsde serve: ended; {len(shelf.all())} diagnoses are kept in {shelf.folder}.")
