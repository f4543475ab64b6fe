"""A scene whose own code fails on some ranks only: the run ends with one message, and no rank waits for another."""

from __future__ import annotations

import pytest
from mpi4py import MPI
from program import one_line, simulated

from dem.together import SceneError
from pctt.options import OptionError

#: What `{where}` does on one rank; the line that fails is marked.
SCENE = '''
from dataclasses import dataclass
from mpi4py import MPI
from dem.experiment import Experiment
from dem.motion import Fixed
from dem.scene import Scene
from dem.shapes import Plane

def fail(where):
    rank = MPI.COMM_WORLD.rank
    if where == "{where}" and rank in {on}:
        {error}  # here

fail("import")

@dataclass(frozen=True)
class Motion:
    def pose(self, time, position, orientation):
        if time > 0:
            fail("motion")
        return position, orientation

@dataclass(frozen=True)
class One(Experiment):
    height: float = 1.0
    def __post_init__(self):
        super().__post_init__()
        fail("post_init")
    def build(self):
        fail("build")
        scene = Scene(0.3)
        scene.add_body("floor", [Plane((0, 0, 1))], Motion())
        scene.add_spheres([[x, 0, self.height] for x in range(4)], 0.1, 1000.0)
        return scene
    def record(self, step):
        if step.world.step == 2:
            fail("record")
        low = step.total(step.world.grains.position[:, 2] < 1.0)
        if step.world.step == 1:
            fail("late record")
        return {{"low": low}}
    def analyse(self, records):
        fail("analyse")
        return {{}}
'''

def scene(where: str = "nowhere", on: tuple[int, ...] = (), error: str = "1 / 0") -> str:
    """The text of a scene file that fails there on these ranks."""
    return SCENE.format(where=where, on=on, error=error)


def line_of_failure(text: str) -> int:
    return next(k for k, line in enumerate(text.splitlines(), 1) if line.endswith("# here"))


DIVISION = "ZeroDivisionError: division by zero"


def fault(what: str, error: str = DIVISION, ranks: str = "rank 1") -> tuple[str, str]:
    """The exception that all of three ranks raise, and its words; {file} and {line} are those of the failure."""
    return "SceneError", f"{{file}}, line {{line}}: {what}: {error}" + (f" (on {ranks} of 3)" if ranks else "")


def refusal(words: str) -> tuple[str, str]:
    return "OptionError", words


BUILD, RECORD, OPTIONS = (f"{what} of the scene One" for what in ("build", "record", "options"))
UNEQUAL_CALLS = scene().replace("low = step.total(", "low = 0 if MPI.COMM_WORLD.rank else step.total(")
UNEQUAL_NAMES = scene().replace('"low": low', '"low " + str(MPI.COMM_WORLD.rank): low')
#: The text of a scene, and what all ranks raise.
CASES = [
    (scene("build", (1,)), fault(BUILD)),
    (scene("record", (1,)), fault(RECORD)),
    (scene("late record", (1,)), fault(RECORD)),
    (scene("motion", (1,)), fault("motion of a large body")),
    (scene("post_init", (1,)), fault(OPTIONS)),
    (scene("analyse", (0,)), fault("analyse of the scene One", ranks="rank 0")),
    (scene("record", (2,), "raise SystemExit"), fault(RECORD, "SystemExit", "rank 2")),
    (
        scene("build", (0, 1, 2), "raise (OSError, KeyError, KeyError)[rank]('no luck')"),
        fault(BUILD, "OSError: no luck (on rank 0 of 3); another failure on ranks 1, 2", ""),
    ),
    (scene("import", (2,)), refusal(f"-scene {{file}}: line {{line}}: {DIVISION} (on rank 2 of 3)")),
    (
        scene("import", (0,), "raise SystemExit"),
        refusal("-scene {file}: line {line}: SystemExit (on rank 0 of 3)"),
    ),
    (
        scene("post_init", (1,), "raise ValueError('height of nothing')"),
        refusal("-scene_height of nothing (on rank 1 of 3)"),
    ),
    (scene("post_init", (1,), "raise ValueError('a bug')"), fault(OPTIONS, "ValueError: a bug")),
    (
        UNEQUAL_CALLS,
        (
            "SceneError",
            "a program must make the same calls on all ranks, but rank 0 at Step.total, rank 1 at the end "
            "of the record of the scene One, rank 2 at the end of the record of the scene One",
        ),
    ),
    (
        scene().replace("Scene(0.3)", "Scene(0.3 + 0.1 * (MPI.COMM_WORLD.rank == 2))"),
        (
            "SceneError",
            f"{BUILD}: rank 2 has built other bodies or materials than rank 0; allowed is the same scene on all ranks "
            "(random numbers need a seed, and no rank a part of its own)",
        ),
    ),
    (UNEQUAL_NAMES, ("SceneError", f"{RECORD}: it must return the same names on all ranks, in the same order")),
]


@pytest.mark.parallel(3)
def test_all_ranks_raise_what_one_of_them_has(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    comm = MPI.COMM_WORLD
    for k, (text, (kind, words)) in enumerate(CASES):
        file = f"case{k}.py"
        if comm.rank == 0:
            (tmp_path / file).write_text(text)
        comm.Barrier()
        database = {"scene": file, "steps": "2", "ccp_type": "apgd", "ccp_tol": "1e-3", "quiet": None, "output": f"{k}"}
        with pytest.raises((SceneError, OptionError)) as failure:
            simulated(database, comm)
        assert type(failure.value).__name__ == kind
        said = words.format(file=file, line=line_of_failure(text))
        assert comm.allgather(str(failure.value)) == [said] * 3


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize(("where", "status"), [("import", 2), ("record", 1)])
def test_the_program_says_it_once(where, status, ranks, program, tmp_path):
    text = scene(where, (ranks - 1,))
    if MPI.COMM_WORLD.rank == 0:
        (tmp_path / "mine.py").write_text(text)
    MPI.COMM_WORLD.Barrier()
    options = ("-scene", "mine.py", "-steps", 2, "-ccp_type", "apgd", "-ccp_tol", "1e-3")
    said = one_line(program(*options, status=status), status)
    assert f"mine.py{',' if where == 'record' else ':'} line {line_of_failure(text)}: " in said
    assert DIVISION in said
    assert ("rank" in said) == (ranks > 1)
