"""The shell lines of README and docs: all are parsed by the programs they start, and those that are cheap run.

A line counts if it is an indented or fenced line of a page, of an example's docstring, or a piece of a sentence that
begins with a command. Options that a sentence names alone (``-ccp_tol 1e-6``) are those of a program, too.
"""

from __future__ import annotations

import argparse
import os
import re
import runpy
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest
import several_ranks
from mpi4py import MPI
from program import database
from test_pages import blocks, stored_problem
from validate import CHECKS

from pctt import export, plot, render
from pctt.compile import main as loops_ahead
from pctt.ksp_options import OF_SOLVERS
from pctt.options import describe
from pctt.run.help import help_text
from pctt.run.options import option_groups, read_options
from pctt.run.settings import find_scene
from pctt.scenes import SCENES

ROOT = Path(__file__).resolve().parents[2]
OF_THE_PAST = ("changelog", "notebook")  # pages that tell of what was
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
PAGES += [page for page in sorted(ROOT.glob("docs/*.md")) if not page.stem.startswith(OF_THE_PAST)]
EXAMPLES = sorted(ROOT.glob("docs/examples/*.py"))
LOOK = {"plot": plot, "render": render, "export": export}

#: What stands for a word of the reader's, and a word of that kind.
STAND_FOR = {"NAME": "mixer", "CHECKOUT": ".", "SCENE": "mixer", "N": "2", "I": "0.1", "F": "0.5", "T": "0.1",
             "FILE": "problem.hdf5", "[FILE": "", "...]": "", "...": "", "DIR": "problems"}  # fmt: skip

#: What no test starts, and why: by the command that stands first.
NOT_OURS = {
    **dict.fromkeys(("pip", "conda", "spack", "podman", "apt-get", "python3"), "installs or builds an environment"),
    **dict.fromkeys(("cp", "mkdir", "cd", "asv", "sbcast", "tar"), "moves files for an installation"),
    **dict.fromkeys(("export", ".", "#SBATCH", "module"), "sets variables of the shell"),
}
#: Commands of this repository that are no study: their words are those of other programs.
OTHERS = {"demo", "test", "setup", "docs", "lint", "release", "elsewhere"}
OF_PETSC = ("log_view", "options_file", "options_left", "help", "version")


def text_of(page: Path) -> str:
    """A page without its blocks of Python, or the docstring of an example."""
    text = page.read_text()
    if page.suffix == ".py":
        return text.partition('"""')[2].partition('"""')[0]
    return re.sub(r"```(?!bash|sh\b|console)\w+\n.*?```", "", text, flags=re.DOTALL).replace("```", "")


def lines_of(page: Path) -> Iterator[str]:
    """The indented and fenced lines of a page, with their continuations."""
    text = text_of(page).replace("\\\n", " ")
    yield from (match[1] for match in re.finditer(r"^(?: {4,}|\$ )(\S.*)$", text, re.MULTILINE))


def pieces_of(page: Path) -> Iterator[str]:
    """The commands in the sentences of a page."""
    text = text_of(page)
    yield from (" ".join(match[1].split()) for match in re.finditer(r"`((?:python -m pctt|mpiexec|run/)[^`]*)`", text))


STARTS = re.compile(
    r"(?:.*\s)?(?:(?:\S*python3? -m pctt\.(?P<module>\w+))|(?:\S*/)?(?P<pctt>pctt)(?= -(?!c\b)))(?P<words>.*)"
    r"|(?:\S+=\S+ )*run/(?P<script>[a-z_]+)(?P<rest>(?: .*)?)"
)


def commands() -> list[tuple[str, str, str]]:
    """Page, program and words of every line that starts one of ours; a script is ``run/NAME``."""
    found = []
    for page in [*PAGES, *EXAMPLES]:
        for line in [*lines_of(page), *pieces_of(page)]:
            match = STARTS.fullmatch(line.strip())
            if match and not (match["script"] and (ROOT / "run" / match["script"]).is_dir()):
                program = f"run/{match['script']}" if match["script"] else match["module"] or "run"
                found.append((page.name, program, (match["rest"] if match["script"] else match["words"]).strip()))
    return list(dict.fromkeys(found))


COMMANDS = commands()


def words_of(text: str) -> list[str]:
    words = [STAND_FOR.get(word, word) for word in shlex.split(text, comments=True)]
    return [word for word in words if word]


def test_lines_of_all_kinds_are_found():
    programs = [program for _, program, _ in COMMANDS]
    assert {"run", "plot", "render", "export", "run/demo", "run/study", "run/settle"} <= set(programs)
    assert len(COMMANDS) > 70


def test_all_other_lines_that_look_like_commands_are_known():
    """They start with one of `NOT_OURS`, or one of our programs."""
    launch = re.compile(r"(\S*/)?(mpiexec|mpirun|srun|apptainer|python|pctt\S*)( .*)|(\./|run/|\.venv/)\S+.*")
    for page in PAGES:
        for line in lines_of(page):
            ours = STARTS.fullmatch(line) or re.match(r"(mpiexec -n \d+ )?\S*python (-c |docs/|-m mpi4py )", line)
            other = any(word.rpartition("/")[2] in NOT_OURS for word in line.split()[:3])
            assert ours or other or not launch.fullmatch(line) or " ..." in line, f"{page.name}: {line}"


def test_other_scripts_of_this_repository_are_there():
    """Those in folders of `run`, and the examples that are programs."""
    for page in [*PAGES, *EXAMPLES]:
        for line in [*lines_of(page), *pieces_of(page)]:
            for script in re.findall(r"(?:^|\s)(run/\w+/\w+|docs/examples/\w+\.py)(?=\s|$)", line):
                assert (ROOT / script).is_file(), f"{page.name}: {line}"
                assert script.endswith(".py") or os.access(ROOT / script, os.X_OK), script


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Where the lines find the files that they name."""
    folder = tmp_path_factory.mktemp("lines")
    (folder / "docs").symlink_to(ROOT / "docs")
    (folder / "hopper.py").write_text(blocks("docs/tutorial.md")[0])
    (folder / "bucket.stl").write_text("solid bucket\nendsolid bucket\n")
    stored_problem(folder / "problem.hdf5")
    for _, program, words in COMMANDS:  # problems of runs of the reader
        for name in re.findall(r"-problem (\S+)", words if program == "run" else ""):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).symlink_to(folder / "problem.hdf5")
    return folder


class ParsedError(Exception):
    """The words of a command line are right; ``rest`` are those that the parser leaves to another program."""

    def __init__(self, rest: list[str]):
        self.rest = rest


def parsed(main, words: list[str], monkeypatch, capsys) -> list[str]:
    """Let a program parse its words and go no further; those that it leaves over."""
    parse = argparse.ArgumentParser.parse_known_args

    def stop(self, args=None, namespace=None):
        found, rest = parse(self, args, namespace)
        if self.prog.count(" ") > 1 and not self.prog.startswith("python"):
            return found, rest  # of a part
        raise ParsedError(rest)

    monkeypatch.setattr(sys, "argv", ["program", *words])
    monkeypatch.setattr(argparse.ArgumentParser, "parse_known_args", stop)
    try:
        main()
    except ParsedError as end:
        return end.rest
    except SystemExit as end:
        code = end.code
    else:
        code = "it parsed nothing"
    assert code == 0, capsys.readouterr().err  # where argparse has said why
    return []


def study(name: str) -> Callable[[], object]:
    """What starts a study in this process; skips the test where a library is not there that only some studies need."""

    def start() -> object:
        try:
            return runpy.run_path(str(ROOT / "run" / "studies" / f"{name}.py"), run_name="__main__")
        except ModuleNotFoundError as error:
            if error.name in ("matplotlib", "vtk"):
                pytest.skip(f"needs {error.name}")
            raise

    return start


def check_run(words: list[str]) -> None:
    """By what refuses options, those without effect too."""
    if "--version" in words:
        return
    if {"-help", "-h"} & set(words):
        topic = words[words.index("-help") + 1 :][:1]
        assert help_text(database(words), topic[0] if topic and topic[0][0] != "-" else "")
    stray = [word for k, word in enumerate(words) if word[0] != "-" and (k == 0 or words[k - 1][0] != "-")]
    assert not stray
    given = {name: value for name, value in database(words).items() if name != "help"}
    elsewhere = {} if "settle" in given else {"output": "elsewhere"}  # the reader's folder is empty
    read_options(elsewhere | given, MPI.COMM_SELF)


@pytest.mark.parametrize(("page", "program", "text"), COMMANDS, ids=lambda text: text[:70])
def test_the_words_of_a_line_are_right(page, program, text, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    words = words_of(text)
    if program == "run":
        check_run(words)
    elif program in LOOK:
        rest = parsed(lambda: LOOK[program].main(MPI.COMM_SELF), words, monkeypatch, capsys)
        assert not rest
    elif program == "compile":
        assert parsed(loops_ahead, words, monkeypatch, capsys) == []
    else:
        script = ROOT / program
        assert os.access(script, os.X_OK)
        name = program.removeprefix("run/")
        if name == "settle" and words:
            scene, n, *more = words
            check_run(["-settle", "-scene", scene, "-scene_n", n, *more])
        elif name == "study" and text not in ("", "NAME"):
            rest = parsed(study(words[0]), words[1:], monkeypatch, capsys)
            if words[0] in ("seeds", "measure"):  # they pass them on
                check_run([*(["-compare", words[words.index("-names") + 1]] if "-names" in words else []), *rest])
            else:
                assert not rest
        elif name == "validate":
            assert {*words} <= {*CHECKS, "-keep", *STAND_FOR.values()}
        else:
            assert name in {*OTHERS, "settle", "study"}
            assert all((ROOT / word).exists() for word in words if "/" in word)


# -- the cheap ones --------------------------------------------------------------------------------------------------

#: What replaces options of a line so that it takes seconds; the rest of the line stays.
SHORT = {"steps": "1", "seconds": "0.01", "scene_n": "1", "output": "out", "overwrite": "true", "output_every": "1"}


def shortened(words: list[str]) -> list[str]:
    """The words of a run with less to do, from the scene's start, not from its settled state."""
    given = {name: value for name, value in database(words).items() if name not in ("restart", "help")}
    if "problem" not in given:
        given = {name: value for name, value in given.items() if name != "seconds"} | {"steps": "1"}
    given |= {name: value for name, value in SHORT.items() if name in given} | {"output": "out", "overwrite": "true"}
    return [word for name, value in given.items() for word in (f"-{name}", *([] if value is None else [value]))]


RUNS = [
    (page, text)
    for page, program, text in COMMANDS
    if program == "run" and not re.search(r"-(settle|help|-version)\b|scene_file", text)
]


@pytest.mark.slow
@pytest.mark.mpi
@pytest.mark.parametrize(("page", "text"), RUNS, ids=lambda text: text[:70])
def test_a_line_runs(page, text, folder, tmp_path):
    """On two ranks where the reader starts several."""
    line = next(line for line in (*lines_of(place_of(page)), *pieces_of(place_of(page))) if text in line)
    program = [sys.executable, "-m", "pctt.run", *shortened(words_of(text))]
    start = several_ranks.mpiexec(2) if re.search("mpiexec|srun", line) else []
    env = several_ranks.environment(XDG_CACHE_HOME=str(tmp_path))
    done = subprocess.run([*start, *program], cwd=folder, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "without effect" not in done.stdout


def place_of(page: str) -> Path:
    return next(path for path in [*PAGES, *EXAMPLES] if path.name == page)


@pytest.mark.slow
def test_a_run_is_drawn_and_exported_by_the_lines_of_their_page(folder, tmp_path):
    """Whatever libraries are there for."""
    env = several_ranks.environment(XDG_CACHE_HOME=str(tmp_path))
    first = ["-m", "pctt.run", "-scene_n", "1", "-steps", "2", "-output_every", "1", "-output", tmp_path / "results"]
    needs = {"plot": "matplotlib", "render": "vtk", "export": "vtk"}
    lines = [(program, text) for _, program, text in COMMANDS if program in LOOK and "-help" not in text]
    lines = [(program, text) for program, text in lines if "-single" in text or find_spec(needs[program])]
    words = [["-m", f"pctt.{program}", *words_of(text)] for program, text in lines]
    runs = sorted({word[2] for word in words} - {"results"})
    for run in runs:  # of other scenes
        (tmp_path / run).parent.mkdir(exist_ok=True)
        (tmp_path / run).symlink_to(tmp_path / "results")
    for line in [first, *words]:
        ours = {"123": "1", "bucket=orange": "mixer=orange"}  # as in results
        shown = [sys.executable, *(ours.get(word, word) for word in map(str, line))]
        done = subprocess.run(shown, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, f"{line}: {done.stdout}{done.stderr}"
    assert len(words) >= 2


# -- options that a sentence names -----------------------------------------------------------------------------------


def options_of_parsers(monkeypatch, capsys) -> set[str]:
    """The options of the programs that look at runs and of the studies of the pages."""
    known: set[str] = set()
    add = argparse.ArgumentParser.add_argument

    def noted(self, *names, **more):
        known.update(name[1:] for name in names if re.match("-[a-z]", name))
        return add(self, *names, **more)

    monkeypatch.setattr(argparse.ArgumentParser, "add_argument", noted)
    mains = [lambda module=module: module.main(MPI.COMM_SELF) for module in LOOK.values()]
    names = {text.split()[0] for _, program, text in COMMANDS if program == "run/study" and text} - {"NAME"}
    names -= set() if find_spec("matplotlib") else {"structure"}
    mains += map(study, sorted(names))
    for main in mains:
        parsed(main, ["-help" if main not in mains[len(LOOK) :] else "--help"], monkeypatch, capsys)
    return known


def test_options_in_sentences_exist(monkeypatch, capsys):
    known = {"quiet", *options_of_parsers(monkeypatch, capsys)}
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "examples"))
    scenes = [find_scene(name) for name in SCENES]
    scenes += [find_scene(str(path)) for path in EXAMPLES if "(Experiment)" in path.read_text()]
    for scene in scenes:
        known |= {line.name for group, start in option_groups(scene) for line in describe(group, start)}
    for page in PAGES:
        for match in re.finditer(r"(?<!`)`(-[a-zA-Z][^`]*)`", text_of(page)):
            for name in re.findall(r"(?:^|\s)-([a-zA-Z]\w+)", match[1]):
                passes = name in known or name in OF_PETSC or name.removeprefix("ccp_").startswith(OF_SOLVERS)
                assert passes or any(one.startswith(name) and name[-1] == "_" for one in known), (
                    f"{page.name}: `{match[1]}`: no program has the option -{name}"
                )
