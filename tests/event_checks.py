"""What holds of the events of every run."""

from collections.abc import Sequence


def ended_stages(events: Sequence[dict]) -> list[str]:
    """Names of stages in the order in which they began; each begins and ends once."""
    numbers = [one["stage"] for one in events if one["kind"] == "stage"]
    names = []
    for number in dict.fromkeys(numbers):
        mine = [one for one in events if one.get("stage") == number]
        first, *between, last = [one["status"] for one in mine]
        assert first == "begin", mine
        assert set(between) <= {"progress"}, mine
        assert last == "done", mine
        assert mine[-1]["seconds"] >= 0
        names.append(mine[0]["name"])
    return names


def share_in_stages(events: Sequence[dict]) -> float:
    """Of the time from the first event to the last, how much lies in any stage."""
    begins = {}
    spans = []
    for one in events:
        if one["kind"] == "stage" and one["status"] == "begin":
            begins[one["stage"]] = one["time"]
        elif one["kind"] == "stage" and one["status"] != "progress":
            spans.append((begins[one["stage"]], one["time"]))
    covered, until = 0.0, events[0]["time"]
    for begin, end in sorted(spans):
        covered += max(0.0, end - max(begin, until))
        until = max(until, end)
    return covered / (events[-1]["time"] - events[0]["time"])
