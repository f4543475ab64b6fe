"""All problems in folders of FCLIB files (docs/files.md), or steps of settled mixers, by all solvers:

    run/study profile_problems [DIR ...] [SOLVER ...] [--mixer N,N] [options]        --help lists the options

Seconds to 1e-4, 1e-6 and 1e-8 of the convex problem and of Coulomb's law, performance profiles, failures counted. Peers
(Siconos, Clarabel) are in it where they are installed: apt-get install python3-siconos, .venv/bin/pip install -e
'.[peers]'. Writes results/profile.json, results/profile.md and results/profile.png, with --page docs/problems.md.
Siconos' text files (.dat) are converted first, in a temporary folder.

A solver works on a problem in a process of its own, cold and on one core, to one tolerance after the other. A
tolerance counts as reached where `pctt.ccp.measure`, which shares no code with any solver, finds the natural
residual (for Coulomb's law: its residual) below it. Fast solves are repeated, the fastest counts.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from convert_problems import convert
from mpi4py import MPI
from peers import PEERS
from shared import (
    ROOT,
    Row,
    called_from,
    figure,
    lines_of,
    listed,
    markdown,
    next_problem,
    parser,
    record,
    replace_table,
    say_machine,
    settled,
)

from dem.contact import find_contacts
from dem.unconstrained import unconstrained
from pctt import ccp
from pctt.ccp import fclib
from pctt.ccp.fclib import FileFormatError
from pctt.scenes import Mixer

SUFFIXES = (".dat", ".hdf5", ".h5")
TOLERANCES = (1e-4, 1e-6, 1e-8)
ROUNDING = 1.01  # of a residual that another formula finds
AGAIN, TIMES = 2.0, 5  # seconds up to which a solve is repeated, and how often at most
STARTUP = 30.0  # seconds that a process may take beside its solves
LAWS = {"convex": "the convex problem", "coulomb": "Coulomb's law"}
OWN = {"convex": list(ccp.SOLVERS), "coulomb": ["conic", "pdip", "auto", "apgd"]}
TABLEAU = ("blue", "orange", "green", "red", "purple", "brown", "pink", "gray", "olive", "cyan")
WITHIN = (1.0, 2.0, 10.0)  # times the fastest, columns of the table
COMM = MPI.COMM_SELF
HEAVIER = 1000.0
VARIANTS = {
    "settled": "a step of the settled packing",
    "friction": "the same with a friction coefficient of 0.8",
    "heavy": "the same with the uppermost grain 1000 times heavier",
    "loose": "the packing stretched by 1 % in height, grains at random velocities of 0.5 m/s and falling",
}

PAGE = ROOT / "docs" / "problems.md"

Rows = list[Row]
Problem = tuple[str, Path, int]  # name, file, contacts


# -- one solver on one problem, in the process of its own ---------------------------------------------------


def solve(path: str, law: str, solver: str, seconds: float) -> Iterator[Row]:
    """What it takes to each tolerance, until the first that is not reached."""
    theirs = 1.0
    if solver not in PEERS:
        once(path, law, solver, TOLERANCES[0], seconds)  # loops may have to be compiled: this one does not count
    for tol in TOLERANCES:
        if solver in PEERS:  # their own stop tests, tightened until ours is met
            runs: Rows = []
            while not runs or (not _reached(runs[-1], tol) and theirs > 1e-13 and runs[-1]["seconds"] < seconds):
                theirs *= 0.1
                runs.append(fastest(path, law, solver, theirs, seconds))
            found = min(runs, key=lambda run: run["residual"])
        else:
            found = fastest(path, law, solver, tol, seconds)
        reached = _reached(found, tol) and found["seconds"] <= seconds  # peers do not always end in time
        yield {"tol": tol, "reached": reached, **found}
        if not reached:
            return


def _reached(found: Row, tol: float) -> bool:
    return bool(found["residual"] <= ROUNDING * tol) and "unbounded" not in found["reason"]


def fastest(path: str, law: str, solver: str, tol: float, seconds: float) -> Row:
    """The fastest of several solves, each of a problem that was read anew."""
    runs = [once(path, law, solver, tol, seconds)]
    while len(runs) < TIMES and sum(run["seconds"] for run in runs) < AGAIN:
        runs.append(once(path, law, solver, tol, seconds))
    return min(runs, key=lambda run: run["seconds"])


class OutOfTimeError(Exception):
    """The solver has had its seconds."""


def once(path: str, law: str, solver: str, tol: float, seconds: float) -> Row:
    """From a cold start. Of a solve that is out of time the best that it looked at is not known."""
    with read(path) as problem:
        impulse, reason = None, f"{seconds:g} s"
        start = time.perf_counter()
        if solver in PEERS:
            impulse, reason = PEERS[solver].solve(problem, tol, seconds)
        else:
            newton = ccp.newton_for(COMM, solver) if ccp.SOLVERS[solver].newton else None
            limits = ccp.Limits(tol, -1 if newton else 10_000_000, np.inf, fallback=False)
            look = problem.errors

            def in_time(*arguments: Any, **named: Any) -> Any:
                if time.perf_counter() > start + seconds:
                    raise OutOfTimeError
                return look(*arguments, **named)

            problem.errors = in_time  # type: ignore[method-assign]
            try:
                of = ccp.COULOMB if law == "coulomb" else ccp.RELAXATION
                result = ccp.solve(problem, None, solver, limits, None, newton, of)
                impulse, reason = result.impulse, result.reason
            except OutOfTimeError:
                pass
            del problem.errors
        found: Row = {"seconds": time.perf_counter() - start, "reason": reason, "residual": np.inf, "objective": None}
        if impulse is not None and np.isfinite(impulse).all():
            accuracy = ccp.measure(problem, impulse)
            residual = accuracy.coulomb_residual if law == "coulomb" else accuracy.natural_residual
            found |= {"residual": float(residual), "objective": accuracy.objective}
        return found


# -- problems -----------------------------------------------------------------------------------------------


def read(path: str | Path) -> ccp.ConeProblem:
    """The problem in a file of `write`, or in an FCLIB file."""
    if not str(path).endswith(".npz"):
        return fclib.read(path, COMM)
    with np.load(path) as file:
        G = ccp.CompactRows(*(file[name] for name in ("frame", "arm", "body", "root")), int(file["columns"]))
        rest = {"point": file["point"], "compliance": file["compliance"]}
        return ccp.ConeProblem(COMM, file["r"], file["mu"], G=G, **rest)


def write(path: Path, problem: ccp.ConeProblem) -> None:
    """A problem of frames and arms, for `read`: in an FCLIB file it would lose them."""
    G = vars(problem.contact_map.source)
    np.savez(path, r=problem.r, mu=problem.mu, point=problem.point, compliance=problem.compliance[:, :2], **G)


def mixers(sizes: list[int], variants: list[str], stiffness: float, folder: Path) -> list[Problem]:
    """The first steps after the settled states of mixers, written into the folder: as `problems` has them."""
    found = []
    for n, variant in [(n, variant) for n in sizes for variant in variants]:
        path = folder / f"mixer_{n}_{variant}.npz"
        with step_problem(n, variant, stiffness) as problem:
            write(path, problem)
            found.append((path.stem, path, problem.size))
    return found


def step_problem(n: int, variant: str, stiffness: float) -> ccp.ConeProblem:
    sim = settled(Mixer(n=n), dt=0.025)
    grains, settings = sim.world.grains, sim.settings
    if variant == "loose":
        rng = np.random.default_rng(0)
        grains.position[:, 2] *= 1.01
        grains.velocity[:, :3] += 0.5 * rng.normal(size=(len(grains), 3)) - np.array([0, 0, 0.5])
    sim.world.pairs.stiffness[:] = stiffness
    contacts = find_contacts(sim.world, settings.delta, unconstrained(sim.world, settings.dt))
    if variant == "friction":
        contacts.friction[:] = 0.8
    if variant == "heavy":
        touched = np.unique(contacts.body)
        top = touched[np.argmax(grains.position[touched[touched < len(grains)], 2])]
        grains.mass[top] *= HEAVIER
        grains.inertia[top] *= HEAVIER
        contacts = None
    return next_problem(sim, contacts)


# -- all of them --------------------------------------------------------------------------------------------


def run(path: Path, law: str, solver: str, seconds: float) -> Rows:
    """A row per tolerance, of a process that is ended when its time is over."""
    limit = seconds * (len(TOLERANCES) + 1) + STARTUP
    rows, failure = lines_of([sys.executable, __file__, "--one", path, law, solver, seconds], limit)
    last = rows[-1] if rows else {"reason": "failed", "residual": np.inf}
    missing = {"reached": False, "seconds": None, "residual": last["residual"], "reason": failure or last["reason"]}
    return rows + [{"tol": tol, **missing} for tol in TOLERANCES[len(rows) :]]


def problems(folders: list[Path], converted: Path) -> tuple[list[Problem], list[str]]:
    """The problems of these folders, each with its file's name, the FCLIB file of it, which may be one in
    ``converted``, and its contacts; and what is wrong with the other files."""
    found, refused = [], []
    for k, path in enumerate(sorted(p for folder in folders for p in folder.iterdir() if p.suffix in SUFFIXES)):
        try:
            as_fclib = convert(path, converted / str(k))[0] if path.suffix == ".dat" else path
            with read(as_fclib) as problem:
                found.append((path.name, as_fclib, problem.size))
        except FileFormatError as error:  # noqa: PERF203 - as many files as a folder has
            refused.append(str(error))
    return found, refused


def ratios(rows: Rows, law: str, tol: float) -> tuple[list[str], np.ndarray]:
    """Solvers, and their seconds over those of the fastest (solvers, problems), inf where they failed."""
    mine = [row for row in rows if (row["law"], row["tol"]) == (law, tol)]
    solvers = list(dict.fromkeys(row["method"] for row in mine))
    names = list(dict.fromkeys(row["problem"] for row in mine))
    seconds = np.full((len(solvers), len(names)), np.inf)
    for row in mine:
        if row["reached"]:
            seconds[solvers.index(row["method"]), names.index(row["problem"])] = row["seconds"]
    best = seconds.min(axis=0, initial=np.inf)
    return solvers, np.where(np.isfinite(seconds), seconds / np.where(np.isfinite(best), best, 1.0), np.inf)


def tables(rows: Rows) -> str:
    """What the profiles show, failures with their reasons, and the seconds of every solve, as Markdown."""
    parts: list[str] = []
    for law, words in LAWS.items():
        mine = [row for row in rows if row["law"] == law]
        if not mine:
            continue
        last = {(row["problem"], row["method"]): row for row in mine if row["tol"] == TOLERANCES[-1]}
        names, solvers = (list(dict.fromkeys(row[key] for row in mine)) for key in ("problem", "method"))
        parts.append(
            f"**{words[0].upper()}{words[1:]}**, {len(names)} problems. Each cell: how many were solved; how\n"
            "many of these in the shortest time of all solvers, in at most twice, and in at most ten times the\n"
            "shortest time."
        )
        parts.append(profile(rows, law))
        parts.append(f"Seconds to {TOLERANCES[-1]:.0e}. If that was not reached, the residual stands in brackets:")
        found = [[last[name, solver] for solver in solvers] for name in names]
        cells = [[name, row[0]["contacts"], *map(_seconds, row)] for name, row in zip(names, found)]
        parts.append(markdown(["", "contacts", *solvers], cells))
        # why solvers did not reach the tightest tolerance
        failed = [row for row in last.values() if not row["reached"]]
        parts.append("\n".join(f"- `{row['method']}`, {row['problem']}: {row['reason']}" for row in failed))
    return "\n\n".join(filter(None, parts))


def profile(rows: Rows, law: str) -> str:
    """The table of how many problems of a law were solved, and how fast."""
    profiles = [ratios(rows, law, tol) for tol in TOLERANCES]
    solvers = profiles[0][0]
    cells = [[f"`{solver}`", *(_counts(ratio[k]) for _, ratio in profiles)] for k, solver in enumerate(solvers)]
    return markdown(["", *(f"{tol:.0e}" for tol in TOLERANCES)], cells)


def write_page(rows: Rows) -> None:
    """The tables of docs/problems.md and its figure."""
    for head, law in {"## Results\n": "convex", "### Coulomb's law\n": "coulomb"}.items():
        replace_table(PAGE, head, profile(rows, law))
    if (drawn := ROOT / "results" / "profile.png").exists():
        shutil.copy(drawn, PAGE.with_name("profile.png"))


def _counts(ratio: np.ndarray) -> str:
    """How many problems were solved, and within how many times the shortest time, of ratios (problems,)."""
    return f"{np.isfinite(ratio).sum()}; " + ", ".join(str(int((ratio <= within).sum())) for within in WITHIN)


def _seconds(row: Row) -> str:
    """Of a solve; where it failed, the residual that it stopped at in brackets, if there is one."""
    if row["reached"]:
        return f"{row['seconds']:.2g}"
    return f"({row['residual']:.1e})" if row["residual"] <= 1.0 else "-"  # that of no impulses is 1


def plot(rows: Rows) -> None:
    """A panel per law and tolerance: the part of the problems solved within so many times the fastest's seconds."""
    laws = [law for law in LAWS if any(row["law"] == law for row in rows)]
    with figure("profile", len(TOLERANCES), len(laws)) as panels:
        for axes, (law, tol) in zip(panels, [(law, tol) for law in laws for tol in TOLERANCES]):
            solvers, ratio = ratios(rows, law, tol)
            names = dict.fromkeys(row["method"] for row in rows)
            colours = {name: f"tab:{TABLEAU[k % len(TABLEAU)]}" for k, name in enumerate(names)}
            finite = ratio[np.isfinite(ratio)]
            end = 2 * finite.max(initial=2.0)
            for k, solver in enumerate(solvers):
                x = np.sort(ratio[k][np.isfinite(ratio[k])])
                x, part = np.append(x, end), np.append(np.arange(1, len(x) + 1), len(x)) / max(1, ratio.shape[1])
                style = {"color": colours[solver], "ls": "--" if solver in PEERS else "-", "lw": 1.4}
                axes.step(np.insert(x, 0, 1.0), np.insert(part, 0, 0.0), where="post", label=solver, **style)
            axes.set(xscale="log", xlim=(1, end), ylim=(0, 1.02), title=f"{LAWS[law]}, {tol:.0e}")
            axes.set(xlabel="seconds over the fastest's", ylabel="part of the problems")
            axes.grid(alpha=0.3)
            axes.legend(fontsize=7, loc="lower right")


def read_words() -> tuple[Namespace, list[Path], dict[str, list[str]]]:
    """Options, folders, and solvers by law of the command line."""
    everything = {
        law: OWN[law] + [name for name, peer in PEERS.items() if peer.installed and peer.coulomb == (law == "coulomb")]
        for law in LAWS
    }
    line = parser("profile_problems", __doc__)
    line.add_argument("words", nargs="*", metavar="DIR or SOLVER", help="folders of problems; solvers, none: all")
    line.add_argument("--seconds", type=float, default=20.0, help="limit of a solve (20)")
    line.add_argument("--laws", type=listed(known=list(LAWS)), default=",".join(LAWS),
                      help=f"of {', '.join(LAWS)}, with commas between (both)")  # fmt: skip
    line.add_argument("--mixer", type=listed(int), default="", help="sizes of settled mixers, with commas between")
    about = "; ".join(f"{name}: {text}" for name, text in VARIANTS.items()).replace("%", "%%")
    line.add_argument("--variants", type=listed(known=list(VARIANTS)), default="settled",
                      help=f"of their steps, with commas between (settled); {about}")  # fmt: skip
    line.add_argument("--stiffness", type=float, default=np.inf, help="of their contacts [N/m] (inf)")
    line.add_argument("--page", action="store_true", help="write the tables and the figure of docs/problems.md")
    given = line.parse_args()
    allowed = sorted({name for names in everything.values() for name in names})
    folders = [called_from(word) for word in given.words if called_from(word).is_dir()]
    asked = [name for word in given.words if not called_from(word).is_dir() for name in word.split(",")]
    if unknown := [name for name in asked if name not in allowed]:
        line.error(f"neither a folder nor a solver: {unknown[0]}: allowed are {', '.join(allowed)}")
    if not folders and not given.mixer:
        line.error("no folder with problems given; allowed is run/study profile_problems DIR [DIR ...] [SOLVER ...]")
    if not given.seconds > 0:
        line.error(f"--seconds {given.seconds:g}: allowed is a number > 0")
    return given, folders, {law: [s for s in everything[law] if not asked or s in asked] for law in given.laws}


def main() -> None:
    given, folders, solvers = read_words()
    with tempfile.TemporaryDirectory() as made:
        found, refused = problems(folders, Path(made))
        found += mixers(given.mixer, given.variants, given.stiffness, Path(made))
        for error in refused:
            print(f"left out: {error}")
        if not found:
            places, allowed = ", ".join(map(str, folders)), ", ".join(SUFFIXES)
            sys.exit(f"run/study profile_problems: no problems in {places}; allowed are files ending in {allowed}")
        about = say_machine() | {"limit": given.seconds, "refused": refused}
        rows = solve_all(found, solvers, about)
    show(rows)
    if given.page:
        write_page(rows)


def solve_all(found: list[Problem], solvers: dict[str, list[str]], about: Row) -> Rows:
    """The rows of all solves, which are recorded as they come."""
    rows: Rows = []
    for law, names in solvers.items():
        for name, path, contacts in found:
            print(f"\n{name}, {contacts} contacts, {LAWS[law]}; limit {about['limit']:g} s")
            print(f"{'':18}" + "".join(f"{tol:>10.0e}" for tol in TOLERANCES), flush=True)
            for solver in names:
                mine = run(path, law, solver, about["limit"])
                case = {"law": law, "problem": name, "contacts": contacts, "method": solver}
                rows += [case | row for row in mine]
                why = "" if mine[-1]["reached"] else f"  {mine[-1]['reason']}"
                print(f"{solver:18}{''.join(f'{_seconds(row):>10}' for row in mine)}{why}", flush=True)
            record("profile", about, rows)
    return rows


def show(rows: Rows) -> None:
    """The figure and the tables."""
    plot(rows)
    text = tables(rows)
    Path("results/profile.md").write_text(text + "\n")
    print("\n" + text)


if __name__ == "__main__":
    if sys.argv[1:] == ["--show"]:
        show(json.loads(Path("results/profile.json").read_text())["rows"])
    elif sys.argv[1:2] == ["--one"]:
        path, law, solver, limit = sys.argv[2:]
        for line in solve(path, law, solver, float(limit)):
            print(json.dumps(line), flush=True)
    else:
        main()
