"""What settled steps cost, their parts, their laws and their Newton systems:

    run/study measure steps [N ...]                                       seconds per phase, 1 and 2 ranks; default 4 8
    run/study measure laws [N ...]             Coulomb's law beside its relaxation, and how high what slides flies; 4
    run/study measure preconditioners [N [-every K] [-names A,B]] [...]    what is not known goes to pctt.run
    run/study measure paper [-n N ...]         the paper's comparison on mixer, blade and shear: seconds of a PDIP
                                               solve and of its set-ups, iterations, for nine preconditioners
    run/study measure pdip [-n N ...]          whole PDIP solves of these scenes, each by one preconditioner; without
                                               sizes it writes its table of docs/preconditioners.md

Writes results/measure_WHAT.json (of preconditioners measure_preconditioners_nN.json), and results/reproduction.png.
"""

from __future__ import annotations

import statistics
from argparse import Namespace
from functools import partial

import shared
from shared import Row, Table, figure, markdown, medians, parser, record, say_machine, settled_steps

STEPS, RANKS = 40, (1, 2)
PHASES = ("search", "assembly", "solve", "advance", "output")
NAMES = "none,ilu,ilu-shifted,pbjacobi,sor,icc-shifted,gamg,hypre,cholesky,tt,bic"
SCENES = ("mixer", "blade", "shear")
METHODS = {("apgd", "1e-4"): 20, ("conic", "1e-6"): 5}  # of `laws`, and how many steps
OF_PAPER = {
    "none": "red", "ilu": "green", "ilu-shifted": "olive", "icc": "brown", "pbjacobi": "gray", "tt": "blue",
    "bic": "orange", "gamg": "purple", "hypre": "pink",
}  # fmt: skip
EVERY = {4: 3, 8: 6, 16: 14}  # Newton systems are sampled, as without a preconditioner one takes up to a minute
WAYS = {
    "pbjacobi": {"ccp_pc_type": "pbjacobi"}, "default": {},
    "bic": {"ccp_pc_type": "python", "ccp_pc_python_type": "pctt.pc.BlockICC"},
}  # fmt: skip
EXACT = ("-ccp_closing_work", "inf")


def steps(given: Namespace, about: Row) -> None:
    """Seconds per phase of settled mixer steps, for each size and number of ranks."""
    print(f"medians of {STEPS} steps by default settings; seconds")
    heads = {name: (name, "9.4f") for name in (*PHASES, "seconds", "least", "most")}
    table = Table(n=("n", "3d"), ranks=("ranks", "5d"), contacts=("contacts", "9.0f"),
                  its=("iterations", "6.0f"), **heads)  # fmt: skip
    rows: list[Row] = []
    for n in given.n:
        for ranks in RANKS:
            _, lines = settled_steps("mixer", n, STEPS, ranks=ranks)
            row = {"n": n, "ranks": ranks, **medians(lines, "contacts", "iterations", "seconds")}
            row |= medians([line["phases"] for line in lines], *PHASES)
            row |= {pick.__name__: pick(line["seconds"] for line in lines) for pick in (min, max)}
            rows.append(row | {"least": row.pop("min"), "most": row.pop("max")})
            table.add(rows[-1])
        print(f"    n = {n}: 1 rank / 2 ranks = {rows[-2]['seconds'] / rows[-1]['seconds']:.2f}")
    record("measure_steps", about, rows)
    if given.n == [4, 8, 16]:
        write_steps(rows, about)


def write_steps(rows: list[Row], about: Row) -> None:
    """The section of docs/measurements.md."""
    lines = []
    for row, last in zip(rows, [None, *rows]):
        faster = f"{last['seconds'] / row['seconds']:.2f}" if last and row["ranks"] > 1 else ""
        times = [f"{1e3 * row[name]:.3g}" for name in (*PHASES, "seconds")]
        counts = [f"{row[name]:,.0f}" for name in ("contacts", "iterations")]
        lines.append([row["n"], row["ranks"], *counts, *times, faster])
    heads = ["n", "ranks", "contacts", "iterations", *(f"{name}, ms" for name in PHASES), "step, ms", "times faster"]
    words = {"cpu": about["cpu"], "cores": about["cores"], "commit": shared.commit(), "table": markdown(heads, lines)}
    page = shared.ROOT / "docs" / "measurements.md"
    shared.replace_section(page, "## The phases of a time step\n", OF_STEPS.format(**words))


OF_STEPS = """`run/study measure steps 4 8 16` writes this section: 40 steps of the settled mixer by the defaults,
medians, on an {cpu} of {cores} cores, commit {commit}.

{table}

The search is made twice in nearly every step: some grain goes further than its margin, and the second search asks what
it may meet.

"""


def laws(given: Namespace, about: Row) -> None:
    """Coulomb's law beside its relaxation: steps from settled states, and how high grains fly that slide."""
    from pctt import ccp

    table = Table(
        scene=("scene", "6"), n=("n", "2d"), method=("method", "10"), law=("law", "10"), seconds=("seconds", "8.3f"),
        solve=("solve", "8.3f"), iterations=("iterations", "10.0f"), overlap_mm=("overlap [mm]", "10.2f"),
        Coulomb_residual=("coulomb_residual", "16.1e"), not_converged=("not_converged", "13d"),
    )  # fmt: skip
    rows: list[Row] = []
    for n, scene in [(n, scene) for n in given.n for scene in SCENES]:
        for (method, tol), count in METHODS.items():
            for law in ccp.LAWS:
                options = (*EXACT, "-output_every", 0, "-ccp_type", method, "-ccp_tol", tol, "-law", law)
                _, lines = settled_steps(scene, n, count, *options)
                row = {"scene": scene, "n": n, "method": f"{method} {tol}", "law": law, **medians(lines, "seconds")}
                row |= medians([line["phases"] for line in lines], "solve")
                row["iterations"] = statistics.mean(line["iterations"] for line in lines)
                row["overlap [mm]"] = 1e3 * max(line["worst_overlap"] for line in lines)
                row["coulomb_residual"] = max(line["coulomb_residual"] for line in lines)
                row["not_converged"] = sum(not line["converged"] for line in lines)
                rows.append(row | {"laws": sorted({line["law"] for line in lines})})
                table.add(rows[-1])
    for law in ccp.LAWS:
        lifts = {name: 1e3 * lift(name, law) for name in ("box", "sphere")}
        print(f"{law:11} lift of the sliding box {lifts['box']:.3f} mm, of the sphere {lifts['sphere']:.3f} mm")
        rows.append({"law": law, **{f"lift_{name} [mm]": value for name, value in lifts.items()}})
    record("measure_laws", about, rows)


def lift(name: str, law: str) -> float:
    """How high a cube that slides over a floor at 2 m/s, or a sphere at rest on a table that turns once a second, gets
    above z = .1 m in 30 steps [m]."""
    from mpi4py import MPI

    from dem.motion import Rotation
    from dem.scene import Scene
    from dem.shapes import Box
    from pctt.simulation import Simulation

    scene, table = Scene(friction=0.5), Rotation((0, 0, 6.2832)) if name == "sphere" else None
    scene.add_body("table", [Box((2, 2, 0.1))], *[table] * (table is not None), position=(0, 0, -0.1))
    if name == "box":
        scene.add_boxes([0, 0, 0.1], (0.1, 0.1, 0.1), 1000.0, velocity=(2, 0, 0))
    else:
        scene.add_spheres([0.5, 0, 0.1], 0.1, 1000.0)
    sim, highest = Simulation(scene, dt=0.01, solver="apgd", tol=1e-8, law=law, comm=MPI.COMM_SELF), 0.0
    for _ in range(30):
        sim.step()
        highest = max(highest, float(sim.positions[0, 2]) - 0.1)
    return highest


def compared(scene: str, n: int, names: str, every: int, *options: object) -> tuple[Row, list[Row]]:
    """The first step after a settled state, and a row for each preconditioner on its Newton systems."""
    exact = ("-dt", 0.025 if scene == "mixer" else 0.01, "-ccp_tol", 1e-4, *EXACT)
    summary, (step,) = settled_steps(scene, n, 1, "-compare", names, "-compare_every", every, *exact, *options)
    rows = [{"name": name, **figures, "solves": step["compare"][name]} for name, figures in summary["compare"].items()]
    for row in rows:
        row["total_s"] = row["setup_s"] + row["solve_s"]
    return step, rows


def preconditioners(given: Namespace, about: Row) -> None:
    """All preconditioners on the same Newton systems of a settled mixer step, every EVERY-th of them."""
    step, rows = compared("mixer", given.n, given.names, given.every, *given.more)
    print(
        f"mixer n = {given.n}: {step['contacts']} contacts, {step['newton_its']} Newton steps to natural residual "
        f"{step['natural_residual']:.1e}, every {given.every}. system, 1 rank"
    )
    base = next(row for row in rows if row["name"] == "pbjacobi")["total_s"]
    table = Table(
        name=("name", "<14"), solved=(lambda row: f"{row['converged']}/{row['systems']}", "8"),
        its_mean=("ksp_its_mean", "9.1f"), its_max=("ksp_its_max", "9d"), setup_s=("setup_s", "9.3f"),
        solve_s=("solve_s", "9.3f"), total_s=("total_s", "9.3f"),
        to_pbjacobi=(lambda row: row["total_s"] / base, "11.2f"),
    )  # fmt: skip
    for row in sorted(rows, key=lambda row: row["total_s"]):
        table.add(row)
    print("\niterations / seconds of each system; in brackets the true residual of one that was not solved")
    for row in rows:
        print(f"{row['name']:14} " + " ".join(f"{cell(*solve):>22}" for solve in row["solves"]))
    record(f"measure_preconditioners_n{given.n}", about, rows)


def cell(converged: bool, iterations: int, seconds: float, residual: float) -> str:
    return f"{iterations} / {seconds:.2f}" + f" ({residual:.0e})" * (not converged)


def paper(given: Namespace, about: Row) -> None:
    """The paper's comparison: seconds of a PDIP solve are means over the systems times their number."""
    heads = ["scene", "n", "contacts", "Newton", "systems", "method", "solved", "iterations"]
    heads += ["residual", "setup_s", "solve_s", "pdip_s", "ratio"]
    rows: list[Row] = []
    for scene, n in [(scene, n) for n in given.n for scene in SCENES]:
        step, found = compared(scene, n, ",".join(OF_PAPER), EVERY.get(n, 1), "-ccp_type", "pdip")
        for row in found:
            case = {"scene": scene, "n": n, "contacts": step["contacts"], "Newton": step["newton_its"]}
            case |= {"systems": row["systems"], "method": row["name"], "solved": row["converged"]}
            times = step["newton_its"] / row["systems"]
            case |= {"iterations": row["ksp_its_mean"], "residual": row["excess_max"]}
            case |= {**{f"{w}_s": times * row[f"{w}_s"] for w in ("setup", "solve")}}
            rows.append(case | {"pdip_s": times * row["total_s"]})
        mine = rows[-len(found) :]
        base = next(row["pdip_s"] for row in mine if row["method"] == "pbjacobi")
        for row in mine:
            row["ratio"] = row["pdip_s"] / base
        print(markdown(heads, [[_short(row[head]) for head in heads] for row in mine]), flush=True)
        record("measure_paper", about, rows)
    picture(rows)


def picture(rows: list[Row]) -> None:
    """Seconds and iterations against contacts, a row of panels for each scene."""
    with figure("reproduction", 3, 3) as axes:
        for i, panel in enumerate(axes):
            scene, what = SCENES[i // 3], ("pdip_s", "setup_s", "iterations")[i % 3]
            for method, colour in OF_PAPER.items():
                points = [row for row in rows if (row["scene"], row["method"]) == (scene, method)]
                x, y = [row["contacts"] for row in points], [max(row[what], 1e-4) for row in points]
                panel.loglog(x, y, "o-", color=f"tab:{colour}", label=method)
            words = {"pdip_s": "PDIP solve [s]", "setup_s": "set-ups of a PDIP solve [s]"}
            panel.set(title=scene, xlabel="contacts", ylabel=words.get(what, "mean BiCGStab iterations"))
            panel.grid(alpha=0.3)
            if i == 0:
                panel.legend(fontsize="small")


def pdip(given: Namespace, about: Row) -> None:
    """Whole PDIP solves of the first step after settled states, each by one preconditioner, in turns."""
    import time

    import numpy as np
    from mpi4py import MPI
    from petsc4py import PETSc
    from shared import next_problem, settled

    import pctt.scenes
    from pctt import ccp

    table = Table(
        scene=("scene", "6"), n=("n", "2d"), contacts=("contacts", "8d"), way=("way", "9"), Newton=("Newton", "6d"),
        its=("iterations", "6d"), residual=("residual", "9.1e"), cpu_s=("cpu_s", "8.2f"), ratio=("ratio", "6.2f"),
    )  # fmt: skip
    rows: list[Row] = []
    for scene, n in [(scene, n) for n in given.n for scene in SCENES]:
        sim = settled(getattr(pctt.scenes, scene.title())(n=n), dt=0.025, solver="apgd", stiffness=np.inf)
        with next_problem(sim) as problem:
            spent: dict[str, list[float]] = {way: [] for way in WAYS}
            for way in (*WAYS, *WAYS) if n < 16 else WAYS:
                for name, value in WAYS[way].items():
                    PETSc.Options()[name] = value
                newton = ccp.newton_for(MPI.COMM_SELF, "pdip")
                start = time.process_time()
                limits = ccp.Limits(1e-4, -1, np.inf, fallback=False)
                result = ccp.solve(problem, None, "pdip", limits, None, newton=newton, law=ccp.RELAXATION)
                spent[way].append(time.process_time() - start)
                newton.destroy()
                for name in WAYS[way]:
                    PETSc.Options().delValue(name)
                case = {"scene": scene, "n": n, "contacts": problem.size, "way": way, "Newton": result.iterations}
                case |= {"iterations": result.ksp_its, "residual": result.residual, "status": result.status.value}
                rows = [row for row in rows if (row["scene"], row["n"], row["way"]) != (scene, n, way)]
                base = min(spent["pbjacobi"])
                rows.append(case | {"cpu_s": min(spent[way]), "ratio": min(spent[way]) / base})
        for row in rows[-len(WAYS) :]:
            table.add(row)
        record("measure_pdip", about, rows)
    if given.n == [4, 8, 16]:
        write_pdip(rows)


def write_pdip(rows: list[Row]) -> None:
    """The table of docs/preconditioners.md."""
    lines = []
    for scene, n in dict.fromkeys((row["scene"], row["n"]) for row in rows):
        mine = [row for row in rows if (row["scene"], row["n"]) == (scene, n)]
        cells = [f"{row['iterations']:,}, {row['cpu_s']:.3g} ({row['ratio']:.2f})" for row in mine]
        lines.append([scene, n, f"{mine[0]['contacts']:,}", cells[0].rpartition(" (")[0], *cells[1:]])
    ways = ("block Jacobi: iterations, s", "default: iterations, s (ratio)", "`BlockICC` always: iterations, s (ratio)")
    page, head = shared.ROOT / "docs" / "preconditioners.md", "**Whole PDIP solves**"
    shared.replace_table(page, head, markdown(["scene", "n", "contacts", *ways], lines))


def _short(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    words = parser("measure", __doc__)
    kinds = words.add_subparsers(dest="what", required=True)
    add = partial(kinds.add_parser, allow_abbrev=False)
    add("steps").add_argument("n", type=int, nargs="*", default=[4, 8], help="sizes of the mixer (4 8)")
    add("laws").add_argument("n", type=int, nargs="*", default=[4], help="sizes of the scenes (4)")
    of_pcs, of_paper = add("preconditioners"), add("paper")
    of_pcs.add_argument("n", type=int, nargs="?", default=4, help="size of the mixer (4)")
    of_pcs.add_argument("-every", type=int, default=1, help="every K-th Newton system (1)")
    of_pcs.add_argument("-names", default=NAMES, help="with commas between")
    of_paper.add_argument("-n", type=int, nargs="*", default=[4, 8, 16], help="sizes of the scenes (4 8 16)")
    add("pdip").add_argument("-n", type=int, nargs="*", default=[4, 8, 16], help="sizes of the scenes (4 8 16)")
    given, given.more = words.parse_known_args()
    if given.more and given.what != "preconditioners":
        words.error(f"{' '.join(given.more)}: not an option of {given.what}")
    studies = {"steps": steps, "laws": laws, "preconditioners": preconditioners, "paper": paper, "pdip": pdip}
    studies[given.what](given, say_machine())
