"""What jobs of a sweep share: worked out once, and never changed by one of them for another."""

from nsde_torch.recall import recall, remembering


def test_what_is_recalled_was_made_once_and_is_a_copy() -> None:
    made: list[int] = []

    def make() -> dict[str, list[int]]:
        made.append(1)
        return {"values": [1, 2]}

    assert recall("key", make) == recall("key", make)
    assert len(made) == 2, "nothing is kept unless it is asked for"
    with remembering():
        recall("key", make)["values"].append(3)
        assert recall("key", make) == {"values": [1, 2]}
        assert len(made) == 3
        recall("other", make)
        assert len(made) == 4
    assert recall("key", make) == {"values": [1, 2]}
    assert len(made) == 5
