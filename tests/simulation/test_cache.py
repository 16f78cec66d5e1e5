"""The cache gives back what was stored, forgives damage, and never answers a changed question."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import nsde_torch.simulation.registry as registry
from nsde_torch.simulation import cache, simulated, spring_runs


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Grows by one for each simulation."""
    made: list[int] = []

    def counted(*args: object, **options: object) -> object:
        made.append(1)
        return spring_runs(*args, **options)  # type: ignore[arg-type]

    known = registry.RECORDINGS["mass_spring_damper"]
    monkeypatch.setitem(registry.RECORDINGS, "mass_spring_damper", replace(known, make=counted))
    return made


def test_a_second_call_reads_what_the_first_wrote(tmp_path: Path, calls: list[int]) -> None:
    first = simulated("mass_spring_damper", cache=tmp_path)
    second = simulated("mass_spring_damper", cache=tmp_path)
    assert len(calls) == 1
    assert first.fingerprint == second.fingerprint
    assert [p.suffix for p in tmp_path.iterdir()] == [".npz"]


@pytest.mark.parametrize(
    "other",
    [
        *({"seed": 1}, {"durations": [3.0]}, {"effects": ["coulomb_friction"]}, {"sensor_noise": 2.0}),
        *({"process_noise": 0.0}, {"force": "multisine"}),
    ],
)
def test_any_other_setting_is_simulated_anew(
    tmp_path: Path, calls: list[int], other: dict[str, object]
) -> None:
    simulated("mass_spring_damper", cache=tmp_path)
    simulated("mass_spring_damper", cache=tmp_path, **other)  # type: ignore[arg-type]
    assert len(calls) == 2


def test_two_ways_to_name_one_effect_share_an_entry(tmp_path: Path, calls: list[int]) -> None:
    simulated("mass_spring_damper", cache=tmp_path, effects=["coulomb_friction"])
    simulated("mass_spring_damper", cache=tmp_path, effects={"coulomb_friction": None})
    assert len(calls) == 1


def test_changed_code_is_simulated_anew(
    tmp_path: Path, calls: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    simulated("mass_spring_damper", cache=tmp_path)
    monkeypatch.setattr(cache, "code_hash", lambda: "other")
    simulated("mass_spring_damper", cache=tmp_path)
    assert len(calls) == 2


@pytest.mark.parametrize("damage", ["empty", "cut", "noise", "flipped", "pickle", "other"])
def test_a_damaged_entry_is_made_anew(tmp_path: Path, calls: list[int], damage: str) -> None:
    first = simulated("mass_spring_damper", cache=tmp_path)
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    if damage == "pickle":
        np.savez(path, key=np.array([{"a": 1}], dtype=object))
    elif damage == "other":
        np.savez(path, key=np.array("another key"))
    else:
        half = len(whole) // 2
        flipped = whole[:half] + bytes((whole[half] ^ 0xFF,)) + whole[half + 1 :]
        damaged = {"empty": b"", "cut": whole[:half], "noise": b"\x00" * 500, "flipped": flipped}
        path.write_bytes(damaged[damage])
    second = simulated("mass_spring_damper", cache=tmp_path)
    third = simulated("mass_spring_damper", cache=tmp_path)
    assert len(calls) == 2
    assert first.fingerprint == second.fingerprint == third.fingerprint


def test_writers_at_the_same_time_leave_one_whole_entry(tmp_path: Path) -> None:
    runs = spring_runs(seed=0)
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda _: cache.store("k", runs, tmp_path), range(32)))
    assert [p.name for p in tmp_path.iterdir()] == ["simulated-k.npz"]
    loaded = cache.load("k", tmp_path)
    assert loaded is not None
    assert all(np.array_equal(a.x, b.x) for a, b in zip(runs, loaded, strict=True))


def test_a_folder_that_cannot_be_written_is_no_fault(tmp_path: Path, calls: list[int]) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("no folder")
    assert len(simulated("mass_spring_damper", cache=blocked)) == 5
    assert len(calls) == 1


def test_the_folder_comes_from_the_argument_then_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("NSDE_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache.cache_folder() == tmp_path / "xdg" / "nsde_torch"
    monkeypatch.setenv("NSDE_CACHE", str(tmp_path / "own"))
    assert cache.cache_folder() == tmp_path / "own"
    assert cache.cache_folder(tmp_path / "said") == tmp_path / "said"
