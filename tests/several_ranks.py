"""Tests on several ranks, all those of one number of ranks in one start of mpiexec.

`@pytest.mark.parallel(1, 2, 3, 4)` runs a test on 1 and on 3 ranks, and on 2 and 4 among the slow tests. Of a test with
many variants three run on several ranks, and the others among the slow tests. Its communicator is `MPI.COMM_WORLD`; its
argument `ranks`, if it has one, is the number. On one rank it is a test as any other. On more, the first such test that
comes up starts `mpiexec -n 3 python -m pytest` with all tests on 3 ranks that were selected;
every rank runs them in the same order and writes down how they ended, and the session that was started by hand reports
that, test by test. A test on which a rank fails, dies or hangs ends that start, and another one goes on behind it.

Workers of pytest-xdist share the results: the first that needs them makes them.
"""

from __future__ import annotations

import faulthandler
import fcntl
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import pytest

T = TypeVar("T")
ROOT = Path(__file__).resolve().parents[1]
INSIDE = "--of-ranks"  # the option by which a pytest inside mpiexec knows the folder where it finds and leaves all
VARIANTS = 3  # of a test on several ranks that are not slow
FEW = 3  # ranks, of tests that are not slow
ENDS = 12000  # characters of what mpiexec said that are shown of a rank that died


def mpiexec(ranks: int) -> list[str]:
    """The words that start a command on several ranks; without an mpiexec the test is skipped."""
    beside = Path(sys.executable).with_name("mpiexec")
    found = str(beside) if beside.exists() else shutil.which("mpiexec")
    if found is None:
        pytest.skip("no mpiexec")
    return [found, "-n", str(ranks)]


def environment(**more: str) -> dict[str, str]:
    """Variables for a program of the project, on one rank or several, that a test starts."""
    own = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("PETSC_OPT", "PYTEST_", "OMPI_MCA_ess", "OMPI_COMM_WORLD", "PMI", "DISPLAY"))
    }
    defaults = {
        "PYTHONPATH": os.pathsep.join(filter(None, [str(ROOT), own.get("PYTHONPATH")])),
        "OMP_NUM_THREADS": "1",
        "OMPI_ALLOW_RUN_AS_ROOT": "1",
        "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
        "OMPI_MCA_rmaps_base_oversubscribe": "1",
    }
    return {**own, **defaults, **more}


def ranks_of(item: pytest.Item) -> int:
    """On how many ranks a test runs."""
    callspec = getattr(item, "callspec", None)
    return callspec.params["ranks"] if callspec and item.get_closest_marker("parallel") else 1


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(INSIDE, type=Path, help="used by tests on several ranks")
    parser.addoption("--rank-seconds", type=float, default=300, help="longest time of a test on several ranks")


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "parallel(*ranks): run on these numbers of ranks, on MPI.COMM_WORLD")
    config.addinivalue_line("markers", "mpi: starts several ranks")
    if config.getoption(INSIDE):
        config.pluginmanager.register(Inside(config))


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    marker = metafunc.definition.get_closest_marker("parallel")
    if marker:
        if "ranks" not in metafunc.fixturenames:
            metafunc.fixturenames.append("ranks")
        # What is right on one rank and on three is right on other numbers, nearly always.
        few = {1, max(n for n in marker.args if n <= FEW)}
        marks = {n: [pytest.mark.mpi] * (n > 1) + [pytest.mark.slow] * (n not in few) for n in marker.args}
        counts = [pytest.param(n, marks=marks[n]) for n in marker.args]
        metafunc.parametrize("ranks", counts, ids=[f"{n} rank{'s' * (n > 1)}" for n in marker.args])


def alone(work: Callable[[Any], T]) -> T:
    """What `work(MPI.COMM_SELF)` gives on the first rank, on all ranks of a test."""
    from mpi4py import MPI

    comm = MPI.COMM_WORLD
    return comm.bcast(work(MPI.COMM_SELF) if comm.rank == 0 else None)


# -- fixtures ----------------------------------------------------------------------------------------------------


@pytest.fixture
def tmp_path(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """A folder of the test's own, the same on all its ranks."""
    if not request.config.getoption(INSIDE):
        return tmp_path
    from mpi4py import MPI

    return MPI.COMM_WORLD.bcast(tmp_path)


@pytest.fixture
def mpirun(tmp_path: Path, request: pytest.FixtureRequest) -> Callable[..., str]:
    """`mpirun(source, ranks, *arguments)` runs a Python program on several ranks and returns what it printed.

    The program finds the packages of the project and the modules beside the test file, starts in `tmp_path`,
    and fails the test, with its messages, if any rank raises (mpi4py then stops the others).
    This is for what needs a process of its own; a test marked `parallel` starts nothing.
    """

    def run(source: str, ranks: int, *arguments: object, seconds: float = 120) -> str:
        program = tmp_path / "program.py"
        program.write_text(source)
        command = [*mpiexec(ranks), sys.executable, "-m", "mpi4py", str(program), *map(str, arguments)]
        env = environment()
        env["PYTHONPATH"] += os.pathsep + str(request.path.parent)
        done = subprocess.run(
            command, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=seconds, check=False
        )
        assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout}\n{done.stderr}"
        return done.stdout

    return run


# -- the session that was started by hand ----------------------------------------------------------------------


@pytest.hookimpl(tryfirst=True)  # before slow tests are left out
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """What a test on several ranks needs is made inside mpiexec; here only its result is wanted. Files with such tests
    come last: then their loops are compiled, and workers that wait for ranks leave them the cores."""
    if not config.getoption(INSIDE):
        variants: dict[tuple[str, int], list[pytest.Item]] = {}
        for item in items:
            if ranks_of(item) > 1 and not item.get_closest_marker("slow"):
                variants.setdefault((item.nodeid.partition("[")[0], ranks_of(item)), []).append(item)
        for alike in variants.values():
            few = {i * len(alike) // VARIANTS for i in range(VARIANTS)}
            for item in [item for i, item in enumerate(alike) if i not in few]:
                item.add_marker(pytest.mark.slow)
        late = {item.path for item in items if item.get_closest_marker("mpi")}
        items.sort(key=lambda item: item.path in late)
        for item in items:
            if ranks_of(item) > 1:
                item.fixturenames = ["several_ranks"]


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    if "several_ranks" not in pyfuncitem.funcargs:
        return None
    outcome, text = pyfuncitem.funcargs["several_ranks"].result(pyfuncitem)
    if outcome == "failed":
        pytest.fail(text, pytrace=False)
    if outcome == "skipped":
        pytest.skip(text)
    return True


@pytest.fixture(scope="session")
def several_ranks(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Starts:
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent  # that of all workers
    return Starts(folder, request.session, request.config.getoption("--rank-seconds"))


class Starts:
    """The results of all tests on several ranks, as (outcome, text)."""

    def __init__(self, folder: Path, session: pytest.Session, seconds: float):
        self.folder, self.session, self.seconds = folder, session, seconds
        self.known: dict[int, dict[str, tuple[str, str]]] = {}

    def result(self, item: pytest.Item) -> tuple[str, str]:
        ranks = ranks_of(item)
        if ranks not in self.known:
            with open(self.folder / "ranks.lock", "w") as lock:  # closing it unlocks; more ranks at a time are slower
                fcntl.flock(lock, fcntl.LOCK_EX)
                path = self.folder / f"ranks-{ranks}.json"
                if not path.exists():
                    path.write_text(json.dumps(self._run(ranks)))
                self.known[ranks] = json.loads(path.read_text())
        return self.known[ranks][item.nodeid]

    def _run(self, ranks: int) -> dict[str, tuple[str, str]]:
        left = [item.nodeid for item in self.session.items if ranks_of(item) == ranks]
        found: dict[str, tuple[str, str]] = {}
        while left:
            folder = self.folder / f"ranks-{ranks}" / str(len(left))
            said = start(self.session.config.rootpath, folder, left, ranks, self.seconds)
            new = {test: outcome for test in left if (outcome := together(folder, test, ranks))}
            if len(new) < len(left):
                # a failure is known by now, so the first without an outcome died; with none at all nothing began
                began = any(folder.glob("rank-*"))
                failed = any(outcome == "failed" for outcome, _ in new.values())
                dead = [test for test in left if test not in new]
                for test in [] if failed else dead[:1] if began else dead:
                    new[test] = "failed", f"{ranks} ranks ended without a result:\n{said[-ENDS:]}"
            found.update(new)
            left = [test for test in left if test not in found]
        return found


def start(root: Path, folder: Path, tests: list[str], ranks: int, seconds: float) -> str:
    """Runs tests on several ranks until one fails, and returns all that was said."""
    folder.mkdir(parents=True)
    (folder / "tests.json").write_text(json.dumps(tests))
    files = sorted({test.partition("::")[0] for test in tests})
    options = ["-o", "addopts=", "-p", "no:xdist", "-p", "no:cacheprovider", "--capture=no", f"--rootdir={root}"]
    limits = [f"--rank-seconds={seconds}", f"{INSIDE}={folder}"]
    done = subprocess.run(
        [*mpiexec(ranks), sys.executable, "-m", "pytest", *options, *limits, *files],
        cwd=root,
        env=environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        check=False,
    )
    (folder / "said").write_text(done.stdout)
    return done.stdout


def together(folder: Path, test: str, ranks: int) -> tuple[str, str] | None:
    """How a test ended: as on the rank that failed, else as on all; None if a rank has not ended it."""
    ended = []
    for rank in range(ranks):
        path = folder / f"rank-{rank}"
        lines = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
        mine = {line["outcome"]: line for line in lines if line["test"] == test}
        if "failed" in mine:
            return "failed", f"on rank {rank} of {ranks}, {mine['failed']['when']}\n{mine['failed']['text']}"
        ended.append("passed" in mine and mine["passed"]["when"] == "teardown")
    if not all(ended):
        return None
    return ("skipped", mine["skipped"]["text"]) if "skipped" in mine else ("passed", "")


# -- one rank of it --------------------------------------------------------------------------------------------


class Inside:
    """The pytest of one rank."""

    def __init__(self, config: pytest.Config):
        from mpi4py import MPI

        self.comm = MPI.COMM_WORLD
        self.folder, self.seconds = config.getoption(INSIDE), config.getoption("--rank-seconds")
        config.option.basetemp = self.folder / f"tmp-{self.comm.rank}"
        self.terminal = os.dup(2)  # a test may capture its own
        self._watch()

    def _watch(self) -> None:
        """In so many seconds from now the rank shows where it is, and ends."""
        faulthandler.dump_traceback_later(self.seconds, exit=True, file=self.terminal)

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        by_name = {item.nodeid: item for item in items}
        items[:] = [by_name[test] for test in json.loads((self.folder / "tests.json").read_text())]

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_protocol(self) -> Iterator[None]:
        self._watch()
        yield
        self.comm.Barrier()  # what a test left under way must not meet the next

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        text = report.longrepr[2] if report.skipped else report.longreprtext
        line = {"test": report.nodeid, "when": report.when, "outcome": report.outcome, "text": text}
        line["seconds"] = round(report.duration, 2)  # for those who wonder what takes long
        with open(self.folder / f"rank-{self.comm.rank}", "a") as file:
            file.write(json.dumps(line) + "\n")
        if report.failed:
            self.comm.Abort(1)  # the others may wait for this one
