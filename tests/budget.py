"""What the tests cost, by file: programs asked of the compiler, and processor seconds.

A run prints both, and its dearest files. ``--budget`` fails a run in which a file costs
more than budget.json grants it; ``--write-budget`` writes there what this run cost.
"""

import collections
import json
import os
import pathlib
import statistics

import jax
import pytest

BUDGET = pathlib.Path(__file__).with_name("budget.json")
TIERS = ("core", "full", "slow")  # core: what has neither of the other two marks
COMPILED = "/jax/core/compile/backend_compile_duration"
# A file finds some programs already made by the files that its worker ran before: 67
# were seen to come and go. Seconds are of the machine, two or three times as many on
# another day: each file is held to the pace of the run's others, and what is caught got
# several times as slow as they did.
MORE_PROGRAMS, FEW_PROGRAMS = 1.25, 150
MORE_SECONDS, FEW_SECONDS = 4.0, 30.0
PACED_SECONDS, PACED_FILES = 1.0, 10  # shorter files, and fewer of them, tell no pace
COLLECTED = pytest.StashKey[set[tuple[str, str]]]()  # also what a run leaves out


def pytest_addoption(parser):
    group = parser.getgroup("budget")
    group.addoption("--budget", action="store_true", help="fail over tests/budget.json")
    group.addoption("--write-budget", action="store_true", help="write it")


def pytest_configure(config):
    config.pluginmanager.register(Cost(config))


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    config.stash[COLLECTED] = {
        (tier_of(item), item.nodeid.partition("::")[0]) for item in items
    }


def processor_seconds():
    """Seconds of all threads of this process, and of the processes it waited for."""
    return sum(os.times()[:4])


def tier_of(item):
    return next(
        (tier for tier in TIERS[:0:-1] if item.get_closest_marker(tier)), "core"
    )


class Cost:
    """Counts around each phase of each test; the process that reports adds up."""

    def __init__(self, config):
        self.config = config
        self.programs = 0
        self.spent = collections.defaultdict(lambda: [0, 0.0])
        self.over = []
        jax.monitoring.register_event_duration_secs_listener(self._listen)

    def _listen(self, event, _seconds, **_):
        self.programs += event == COMPILED

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_setup(self, item):
        self.before = (self.programs, processor_seconds())
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item):
        report = yield
        now = (self.programs, processor_seconds())
        report.tier = tier_of(item)
        report.cost = [new - old for new, old in zip(now, self.before, strict=True)]
        self.before = now
        return report

    def pytest_runtest_logreport(self, report):
        spent = self.spent[report.tier, report.nodeid.partition("::")[0]]
        spent[:] = [sum(pair) for pair in zip(spent, report.cost, strict=True)]

    def pytest_sessionfinish(self, session):
        if hasattr(session.config, "workerinput"):
            return
        if session.config.getoption("write_budget"):
            write(self.spent)
        if session.config.getoption("budget"):
            self.over = over_budget(self.spent, read())
            if self.over and session.exitstatus == pytest.ExitCode.OK:
                session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter):
        for line in summary(self.spent):
            terminalreporter.write_line(line)
        for line in self.over:
            terminalreporter.write_line(line, red=True)


def read():
    """``{(tier, file): (programs, processor seconds)}`` of budget.json."""
    tiers = json.loads(BUDGET.read_text())
    return {(tier, path): cost for tier in tiers for path, cost in tiers[tier].items()}


def write(spent):
    """Put what was spent into budget.json; what this run did not touch stays."""
    costs = read() if BUDGET.exists() else {}
    costs = {key: cost for key, cost in costs.items() if pathlib.Path(key[1]).exists()}
    costs |= {key: [count, round(used, 1)] for key, (count, used) in spent.items()}
    lines = []
    for tier in TIERS:
        files = (
            f"    {json.dumps(path)}: {json.dumps(costs[of, path])}"
            for of, path in sorted(costs)
            if of == tier
        )
        lines.append(f'  "{tier}": {{\n' + ",\n".join(files) + "\n  }")
    BUDGET.write_text("{\n" + ",\n".join(lines) + "\n}\n")


def pace(spent, granted):
    """Times the granted seconds that the files of a run took: the median, 1 or more."""
    times = [
        spent[key][1] / granted[key][1]
        for key in spent
        if key in granted and granted[key][1] >= PACED_SECONDS
    ]
    return max(1.0, statistics.median(times)) if len(times) >= PACED_FILES else 1.0


def over_budget(spent, granted):
    """A line for each file that cost more than it may, the worst first."""
    lines, slow = [], pace(spent, granted)
    for key, (programs, seconds) in spent.items():
        tier, path = key
        if key not in granted:
            lines.append((0, f"{path} ({tier}) is not in budget.json: --write-budget"))
            continue
        programs_granted, seconds_granted = granted[key]
        most = MORE_PROGRAMS * programs_granted + FEW_PROGRAMS
        longest = slow * (MORE_SECONDS * seconds_granted + FEW_SECONDS)
        if programs > most:
            text = f"{path} ({tier}): {programs} programs for {most:.0f} at most"
            lines.append((programs / most, text))
        if seconds > longest:
            text = f"{path} ({tier}): {seconds:.0f} processor seconds for {longest:.0f}"
            lines.append((seconds / longest, text))
    return [text for _, text in sorted(lines, reverse=True)]


def summary(spent, shown=5):
    """The sum of programs and processor seconds, and the dearest files."""
    programs, seconds = (sum(cost[i] for cost in spent.values()) for i in (0, 1))
    yield f"{programs} programs, {seconds:.0f} processor seconds; the dearest files:"
    dearest = sorted(spent.items(), key=lambda item: item[1][1], reverse=True)
    for (tier, path), (count, used) in dearest[:shown]:
        yield f"{used:7.1f} s {count:6d} programs  {path} ({tier})"
