"""The stirred mixer by LIGGGHTS and by `pctt.Simulation`, from the same settled beds on the same core:

    run/study compare_liggghts [N ...] [--seconds S,S] [--starts M,M] [--stiffness K,K] [--ours SETTINGS ...]
    run/study compare_liggghts --cores [N ...] [--seconds S,S]

LIGGGHTS is not part of this project: apt-get install liggghts. It has linear springs and dashpots, kt = 2/7 kn,
restitution 0.3, and steps of a tenth of the contact time, as its users choose them. SETTINGS of ours are fields of
`pctt.Settings`, dt=0.01,tol=1e-3,closing_work=inf, or `default`; the solver is `apgd`.

A start is the settled state of the mixer with every sphere moved by up to a hundredth of a millimetre, another way in
every start, so that the courses part. Both codes take the same starts. For each of them the table has

- CPU seconds per simulated second on one core, without start-up: median of the starts;
- the worst overlap, of samples 25 ms apart, by one formula for both;
- the torque on the paddle and the force on the floor over the weight, means of the time after the first 0.1 s, in which
  both codes forget how the bed was settled, with the standard error that the starts show;
- the peak of memory in RAM.

The limit of small steps and stiff contacts, from which errors of the torque are reckoned, is the mean of two that know
nothing of each other: LIGGGHTS with its stiffest contacts, and our smallest steps. Its standard error is what the two
show, or what their starts do, if that is more. Writes results/compare_liggghts.json and .png; without words (15
minutes) its section of docs/measurements.md and docs/liggghts.png, too.

With --cores it measures seconds by the clock on one rank and on two, of one start: LIGGGHTS with 1e8 N/m, and our
defaults. Without more words it writes a section, too: 5 minutes, and half an hour once to settle the bed of n = 32.
"""

from __future__ import annotations

import argparse
import math
import re
import resource
import shutil
import statistics
import string
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shared
from scipy.spatial import cKDTree
from shared import Row, Table, settings_of, settled, spread

from pctt.scenes import Mixer

FORGETS = 0.1  # [s] from the start, not part of means and overlaps
SAMPLES = 0.025  # [s] between two samples of positions
MOVED = 1e-5  # [m]
RESTITUTION = 0.3
STIFF = 1e8  # of LIGGGHTS on one rank and on two [N/m]
CONTACT_STEPS = 10  # time steps of LIGGGHTS in a contact
OURS = ("default", "dt=.015,tol=1e-3")
LETTERS = string.ascii_lowercase + string.ascii_uppercase  # of the rows, in the figure


class LiggghtsError(Exception):
    """LIGGGHTS is not installed, or has failed."""


@dataclass(frozen=True)
class Start:
    """The bed and the paddle at time zero of a comparison."""

    mixer: Mixer
    position: np.ndarray  #: (spheres, 3) [m]
    velocity: np.ndarray  #: (spheres, 6) [m/s, rad/s]
    angle: float  #: of the paddle about the vertical [rad]
    middle: float  #: height of its centre [m]

    @property
    def half(self) -> np.ndarray:
        """Half extents (3,) of the paddle [m]."""
        mixer = self.mixer
        return 0.5 * mixer.width * np.array([mixer.paddle_length, mixer.paddle_thickness, mixer.paddle_height])

    @property
    def mass(self) -> float:
        """Of a sphere [kg]."""
        return 4 / 3 * math.pi * self.mixer.radius**3 * self.mixer.density

    @property
    def weight(self) -> float:
        """Of all spheres [N]."""
        return len(self.position) * self.mass * self.mixer.gravity

    def in_paddle(self, points: np.ndarray, seconds: float, back: bool = True) -> np.ndarray:
        """Points (n, 3) in the frame of the paddle, so many seconds after the start; else from there to the world's."""
        angle = self.angle + self.mixer.angular_velocity * seconds
        cos, sin = math.cos(angle), math.sin(angle)
        turn, center = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]), np.array([0, 0, self.middle])
        return (points - center) @ turn if back else points @ turn.T + center


class Course(NamedTuple):
    """What a run of one of the codes shows."""

    time: np.ndarray  #: (n,) since the start [s]
    torque: np.ndarray  #: (n,) that turns the paddle [N m]
    floor: np.ndarray  #: (n,) force of the spheres on the floor [N]
    samples: list[tuple[float, np.ndarray]]  #: time since the start [s] and positions (spheres, 3) [m]
    cpu: float  #: [s]
    memory: float  #: [MiB]
    unsolved: int  #: time steps


def start_of(n: int, seed: int) -> Start:
    mixer = Mixer(n=n)
    with settled(mixer, seed, MOVED, solver="apgd") as sim:
        paddle = sim.body("mixer")
        angle = 2 * math.atan2(paddle.orientation[3], paddle.orientation[0])
        return Start(mixer, sim.positions, sim.velocities, angle, paddle.position[2])


def overlap(start: Start, position: np.ndarray, seconds: float) -> float:
    """The greatest of spheres (n, 3) with each other, the walls, the floor and the paddle, as a part of a radius."""
    radius, wall = start.mixer.radius, start.mixer.width / 2
    pairs = cKDTree(position).query_pairs(2 * radius, output_type="ndarray")
    apart = np.linalg.norm(position[pairs[:, 0]] - position[pairs[:, 1]], axis=1)
    beyond = np.abs(start.in_paddle(position, seconds)) - start.half
    from_paddle = np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)
    gaps = [apart - 2 * radius, position[:, 2] - radius, from_paddle - radius]
    gaps += [wall - np.abs(position[:, axis]) - radius for axis in (0, 1)]
    return -min(float(gap.min(initial=0.0)) for gap in gaps) / radius


def peak_memory(process: int | str) -> float:
    """The most that a process had in RAM [MiB]; 0 if it has ended. Those that `resource` tells have that of its parent,
    too."""
    try:
        found = re.search(r"VmHWM:\s+(\d+)", Path(f"/proc/{process}/status").read_text())
    except OSError:
        found = None
    return int(found[1]) / 1024 if found else 0.0


# -- this project -----------------------------------------------------------------------------------------------


def ours(n: int, seed: int, seconds: float, settings: dict[str, Any]) -> Course:
    """Steps of a simulation; a step of another one first, which loads compiled loops."""
    settings = {"solver": "apgd", **settings}
    with settled(Mixer(n=n), seed, MOVED, **settings) as first:
        first.step()
    del first  # its memory is not that of a run
    with settled(Mixer(n=n), seed, MOVED, **settings) as sim:
        begun, dt, spent, unsolved = sim.time, sim.settings.dt, 0.0, 0
        box, every, rows, samples = len(sim.positions), max(1, round(SAMPLES / dt)), [], []
        for step in range(1, round(seconds / dt) + 1):
            before = time.process_time()
            unsolved += not sim.step()["converged"]
            spent += time.process_time() - before
            contacts = sim.contacts
            floor = (contacts.bodies[:, 1] == box) & (contacts.normal[:, 2] < -0.99)
            rows.append((sim.time - begun, -sim.body("mixer").torque[2], -contacts.force[floor, 2].sum()))
            if step % every == 0:
                samples.append((sim.time - begun, sim.positions))
            del contacts, floor
    return Course(*np.array(rows).T, samples, spent, peak_memory("self"), unsolved)


# -- LIGGGHTS ---------------------------------------------------------------------------------------------------


def contact_law(stiffness: float, mass: float) -> dict[str, float]:
    """Damping along the normal and across [kg/s] of a contact of two spheres, and the time step [s]."""
    decay = -math.log(RESTITUTION)
    share = decay / math.hypot(math.pi, decay)  # of the critical damping
    normal = 2 * share * math.sqrt(stiffness * mass / 2)
    lasts = math.pi / math.sqrt(2 * stiffness / mass * (1 - share**2))
    return {"normal": normal, "tangential": 0.5 * normal * math.sqrt(2 / 7), "dt": lasts / CONTACT_STEPS}


def stl(name: str, triangles: np.ndarray) -> str:
    """Triangles (n, 3, 3) as an STL file; LIGGGHTS computes the normals itself."""
    lines = [f"solid {name}"]
    for triangle in triangles:
        corners = [f"vertex {x:.12g} {y:.12g} {z:.12g}" for x, y, z in triangle]
        lines += ["facet normal 0 0 0", "outer loop", *corners, "endloop", "endfacet"]
    return "\n".join([*lines, f"endsolid {name}", ""])


def meshes(start: Start) -> dict[str, str]:
    """The files of the floor and the paddle."""
    corner = start.half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    paddle = start.in_paddle(corner, 0.0, back=False)[[[(a, b, c), (a, c, d)] for a, b, c, d in sides]]
    end = start.mixer.width / 2 + 2 * start.mixer.radius
    floor = np.array([[-end, -end, 0], [end, -end, 0], [end, end, 0], [-end, end, 0]])[[(0, 1, 2), (0, 2, 3)]]
    return {"paddle.stl": stl("paddle", paddle.reshape(-1, 3, 3)), "floor.stl": stl("floor", floor)}


def atoms(start: Start) -> str:
    """The data file with the spheres."""
    mixer, numbers = start.mixer, np.arange(1, len(start.position) + 1)
    side, top = mixer.width / 2 + 3 * mixer.radius, start.position[:, 2].max() + mixer.width
    lines = ["mixer", "", f"{len(numbers)} atoms", "1 atom types"]
    lines += [f"{-side} {side} {axis}lo {axis}hi" for axis in "xy"] + [f"{-3 * mixer.radius} {top} zlo zhi"]
    form = " ".join(["%.15g"] * 3)
    places = [f"{n} 1 {2 * mixer.radius} {mixer.density} {form % tuple(x)}" for n, x in zip(numbers, start.position)]
    speeds = [f"{n} {form % tuple(v[:3])} {form % tuple(v[3:])}" for n, v in zip(numbers, start.velocity)]
    return "\n".join([*lines, "", "Atoms", "", *places, "", "Velocities", "", *speeds, ""])


def script(start: Start, stiffness: float, steps: int, ranks: int = 1) -> str:
    """The input of LIGGGHTS, which shares the bed among ranks by halves of its length: by itself it would by height."""
    mixer, law = start.mixer, contact_law(stiffness, start.mass)
    dt, wall = law["dt"], start.mixer.width / 2
    properties = {"kn": stiffness, "kt": stiffness * 2 / 7, "gamman_abs": law["normal"]}
    properties |= {"gammat_abs": law["tangential"], "coefficientFriction": mixer.friction}
    values = [f"fix {name} all property/global {name} peratomtypepair 1 {x:.12g}" for name, x in properties.items()]
    model = "model hooke/stiffness tangential history"
    planes = [
        f"fix wall_{axis}{side} all wall/gran {model} primitive type 1 {axis}plane {place} absolute_damping on"
        for axis in "xy"
        for side, place in enumerate((-wall, wall))
    ]
    lines = f"""
        atom_style granular
        atom_modify map array
        boundary f f f
        newton off
        communicate single vel yes
        processors {ranks} 1 1
        units si
        read_data atoms.data
        neighbor {0.1 * mixer.radius} bin
        neigh_modify delay 0
        {{properties}}
        pair_style gran {model} absolute_damping on
        pair_coeff * *
        timestep {dt:.12g}
        fix move all nve/sphere
        fix weight all gravity {mixer.gravity} vector 0.0 0.0 -1.0
        {{planes}}
        fix floor all mesh/surface/stress file floor.stl type 1 reference_point 0 0 0
        fix paddle all mesh/surface/stress file paddle.stl type 1 reference_point 0 0 {start.middle}
        fix tools all wall/gran {model} mesh n_meshes 2 meshes floor paddle absolute_damping on
        fix turn all move/mesh mesh paddle rotate origin 0 0 {start.middle} axis 0 0 1 period {{period:.12g}}
        variable torque equal f_paddle[6]
        variable force equal f_floor[3]
        thermo_style custom step v_torque v_force
        thermo {max(1, round(1e-3 / dt))}
        thermo_modify lost warn norm no
        dump positions all custom {max(1, round(SAMPLES / dt))} sample_*.bin id x y z
        run {steps}
    """
    text = lines.replace("\n        ", "\n").format(
        properties="\n".join(values), planes="\n".join(planes), period=2 * math.pi / mixer.angular_velocity
    )
    return text.lstrip()


def sampled(path: Path, spheres: int) -> np.ndarray:
    """Positions (spheres, 3) in the order of their numbers, from a binary dump of one rank, which ends with the rows
    number, x, y, z."""
    table = np.frombuffer(path.read_bytes()[-32 * spheres :], dtype=float).reshape(spheres, 4)
    return table[np.argsort(table[:, 0]), 1:]


class Spent(NamedTuple):
    """Of a run of LIGGGHTS."""

    said: str
    cpu: float
    seconds: float  #: by the clock
    memory: float


def liggghts_run(folder: Path, ranks: int = 1) -> Spent:
    """Run the input in the folder; LiggghtsError if that fails."""
    before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    memory = 0.0
    with (folder / "said").open("w+") as said:
        command = [str(shared.MPIEXEC), "-n", str(ranks)] if ranks > 1 else []
        command += ["liggghts", "-in", "script", "-log", "none"]
        process = subprocess.Popen(command, cwd=folder, stdout=said, stderr=subprocess.STDOUT)
        while process.poll() is None:
            memory = max(memory, peak_memory(process.pid))
            time.sleep(0.02)
        said.seek(0)
        text = said.read()
    if process.returncode:
        raise LiggghtsError(f"LIGGGHTS failed with code {process.returncode}:\n{text[-1500:]}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Spent(text, cpu, time.perf_counter() - begun, memory)


def put_input(folder: Path, start: Start) -> None:
    """All files of a run but the script."""
    for file, text in {**meshes(start), "atoms.data": atoms(start)}.items():
        (folder / file).write_text(text)


def theirs(start: Start, stiffness: float, seconds: float) -> Course:
    """A run of LIGGGHTS, whose CPU seconds are those beyond a run of no steps."""
    dt = contact_law(stiffness, start.mass)["dt"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        put_input(folder, start)
        (folder / "script").write_text(script(start, stiffness, 0))
        nothing = liggghts_run(folder)
        (folder / "script").write_text(script(start, stiffness, round(seconds / dt)))
        spent = liggghts_run(folder)
        rows = re.findall(r"^ +(\d+) +(\S+) +(\S+) *$", spent.said, re.MULTILINE)
        step, torque, force = np.array(rows, dtype=float)[1:].T
        files = sorted((int(path.stem.split("_")[1]), path) for path in folder.glob("sample_*.bin"))
        samples = [(number * dt, sampled(path, len(start.position))) for number, path in files if number]
    return Course(step * dt, -torque, -force, samples, spent.cpu - nothing.cpu, spent.memory, 0)


# -- the table ----------------------------------------------------------------------------------------------------


def row(start: Start, seconds: float, courses: list[Course]) -> Row:
    """Of the starts of one setting."""
    late = [course.time > FORGETS for course in courses]
    torque, error = spread([float(course.torque[part].mean()) / 1e3 for course, part in zip(courses, late)])
    floor = [float(course.floor[part].mean()) / start.weight for course, part in zip(courses, late)]
    found = [overlap(start, x, t) for course in courses for t, x in course.samples if t > FORGETS]
    return {
        "cpu": statistics.median(course.cpu for course in courses) / seconds,
        "torque": torque,
        "torque_error": error,
        "overlap": 100 * max(found),
        "floor": statistics.fmean(floor),
        "memory": max(course.memory for course in courses),
        "unsolved": sum(course.unsolved for course in courses),
    }


def limit_of(rows: list[Row]) -> tuple[float, float]:
    """The torque for small steps and stiff contacts and its standard error, as the top of the file says."""
    stiffest = max((row for row in rows if row["code"] == "LIGGGHTS"), key=lambda row: row["stiffness"])
    own = [row for row in rows if "dt" in row and "stiffness" not in row]
    both = [stiffest, *([min(own, key=lambda row: (row["dt"], row.get("tol", 1.0)))] if own else [])]
    print("limits: " + ", ".join(f"{row['torque']:.2f} +- {row['torque_error']:.2f}" for row in both))
    of_starts = math.hypot(*(row["torque_error"] for row in both)) / len(both)
    value, of_codes = spread([row["torque"] for row in both])
    return value, max(of_starts, of_codes if len(both) > 1 else 0.0)


def compare(n: int, seconds: float, count: int, words: argparse.Namespace) -> list[Row]:
    starts = [start_of(n, seed) for seed in range(count)]
    print(f"mixer n = {n}, {len(starts[0].position)} spheres, {count} starts of {seconds:g} s")
    table = Table(
        row=("letter", "3"), name=("name", "<66"), CPU_s_per_s=("cpu", "11.2f"), overlap=("overlap", "7.2f"),
        torque_kN_m=("torque", "11.2f"), error=("torque_error", "5.2f"), floor=("floor", "6.3f"),
        MiB=("memory", "6.0f"), unsolved=("unsolved", "8d"),
    )  # fmt: skip
    rows: list[Row] = []

    def add(about: Row, courses: list[Course]) -> None:
        rows.append(about | row(starts[0], seconds, courses) | {"letter": LETTERS[len(rows)]})
        table.add(rows[-1])

    for stiffness in words.stiffness:
        about = {"code": "LIGGGHTS", "name": f"LIGGGHTS k = {stiffness:g} N/m", "stiffness": stiffness}
        add(about, [theirs(start, stiffness, seconds) for start in starts])
    for setting in words.ours:
        about, seeds = {"code": "pctt", "name": f"pctt {setting}", **settings_of(setting)}, range(count)
        add(about, [shared.in_new_process(ours, n, seed, seconds, settings_of(setting)) for seed in seeds])
    limit, error = limit_of(rows)
    print(f"limit {limit:.2f} +- {error:.2f} kN m")
    case = {"n": n, "seconds": seconds, "starts": count, "limit": limit, "limit_error": error}
    return [case | row for row in rows]


def on_cores(n: int, seconds: float) -> Row:
    """Seconds by the clock per simulated second of both codes, on one rank and on two."""
    start, found = start_of(n, 0), {"n": n, "seconds": seconds}
    with settled(Mixer(n=n), solver="apgd") as sim:
        steps = round(seconds / sim.settings.dt)
    for ranks in (1, 2):
        spent = []
        with tempfile.TemporaryDirectory() as name:
            put_input(folder := Path(name), start)
            for their_steps in (0, round(seconds / contact_law(STIFF, start.mass)["dt"])):
                (folder / "script").write_text(script(start, STIFF, their_steps, ranks))
                spent.append(liggghts_run(folder, ranks).seconds)
        _, lines = shared.settled_steps("mixer", n, steps + 1, "-ccp_type", "apgd", ranks=ranks)
        found[f"theirs_{ranks}"] = (spent[1] - spent[0]) / seconds
        ours = sum(line["seconds"] for line in lines[1:])  # the first loads compiled loops
        found[f"ours_{ranks}"] = ours / (lines[-1]["time"] - lines[0]["time"])
    found |= {f"{code}_faster": found[f"{code}_1"] / found[f"{code}_2"] for code in ("theirs", "ours")}
    return found | {f"ratio_{ranks}": found[f"ours_{ranks}"] / found[f"theirs_{ranks}"] for ranks in (1, 2)}


def cores(sizes: list[int], seconds: list[float], about: Row) -> list[Row]:
    """The table of one and two ranks."""
    names = [f"{name}_{ranks}" for name in ("theirs", "ours", "ratio") for ranks in (1, 2)]
    faster = {name: (name, "13.2f") for name in ("theirs_faster", "ours_faster")}
    table = Table(n=("n", "3d"), **{name: (name, "9.3g") for name in names}, **faster)
    rows: list[Row] = []
    for n, simulated in zip(sizes, cycle(seconds)):
        rows.append(on_cores(n, simulated))
        table.add(rows[-1])
        shared.record("compare_liggghts_cores", about, rows)
    return rows


def write_cores(rows: list[Row], about: Row) -> None:
    """The section of docs/measurements.md."""
    lines = []
    for row in rows:
        values = [f"{row[f'{code}_{ranks}']:.3g}" for code in ("theirs", "ours") for ranks in (1, 2)]
        ratios = [f"{row[name]:.2f}" for name in ("theirs_faster", "ours_faster", "ratio_1", "ratio_2")]
        lines.append([row["n"], *values, *ratios])
    heads = ["n", "LIGGGHTS, 1 rank", "2 ranks", "pctt, 1 rank", "2 ranks", "LIGGGHTS, times faster", "pctt",
             "pctt over LIGGGHTS, 1 rank", "2 ranks"]  # fmt: skip
    words = {"cpu": about["cpu"], "commit": shared.commit(), "table": shared.markdown(heads, lines)}
    shared.replace_section(PAGE, HEAD_OF_CORES, TEXT_OF_CORES.format(**words))


def draw(sizes: list[list[Row]]) -> None:
    """Error of the torque over CPU seconds, a panel for each size, with the letters of the rows."""
    with shared.figure("compare_liggghts", len(sizes)) as panels:
        for axes, rows in zip(panels, sizes):
            limit = rows[0]["limit"]
            blur = 100 * np.nan_to_num(rows[0]["limit_error"]) / limit  # one start has no error
            for label, marker, chosen in (
                ("LIGGGHTS", "s", [row for row in rows if row["code"] == "LIGGGHTS"]),
                ("pctt, default", "*", [row for row in rows if row["name"] == "pctt default"]),
                ("pctt", "o", [row for row in rows if row["code"] == "pctt" and row["name"] != "pctt default"]),
            ):
                if not chosen:
                    continue
                off = [100 * (row["torque"] / limit - 1) for row in chosen]
                bars = [100 * np.nan_to_num(row["torque_error"]) / limit for row in chosen]
                axes.errorbar([row["cpu"] for row in chosen], off, bars, fmt=marker, capsize=2, label=label)
                for row, error in zip(chosen, off):
                    axes.annotate(row["letter"], (row["cpu"], error), (5, -9), textcoords="offset points")
            axes.axhspan(-blur, blur, color="0.9", zorder=0, label="standard error of the limit")
            axes.axhline(0.0, color="0.6", linewidth=0.8)
            axes.set(xscale="log", xlabel="CPU s per simulated s", ylabel="torque off its limit, %")
            least, most = min(row["cpu"] for row in rows), max(row["cpu"] for row in rows)
            costs = [digit * 10.0**power for power in range(-1, 4) for digit in (1, 2, 5)]
            axes.set_xticks([cost for cost in costs if least <= cost <= most])
            axes.set_xlim(0.8 * least, 1.3 * most)
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_formatter("")
            axes.set_title(f"mixer n = {rows[0]['n']}, limit {limit:.1f} kN m")
            axes.legend(fontsize=7)


def write_page(sizes: list[list[Row]], about: Row) -> None:
    """The section of docs/measurements.md, and its figure."""
    lines = []
    for rows in sizes:
        stiff = next(row["cpu"] for row in rows if row["name"] == "LIGGGHTS k = 1e+08 N/m")
        for row in rows:
            error = "" if np.isnan(row["torque_error"]) else f" ± {row['torque_error']:.1f}"
            torque = f"{row['torque']:,.1f}{error}"
            figures = f"{row['cpu']:.2f}", f"{row['cpu'] / stiff:.2f}", f"{row['overlap']:.1f}", torque
            begins = f"n = {row['n']}, {row['starts']} x {row['seconds']:g} s" if row is rows[0] else ""
            lines.append([begins, row["name"], *figures, f"{row['floor']:.3f}", f"{row['memory']:.0f}"])
    heads = ["", "settings", "CPU s/s", "over k = 1e8", "overlap, %", "torque, kN m", "floor", "MiB"]
    words = {"cpu": about["cpu"], "commit": shared.commit(), "table": shared.markdown(heads, lines)}
    shared.replace_section(PAGE, HEAD, TEXT.format(**words))
    if (figure := shared.ROOT / "results" / "compare_liggghts.png").exists():
        shutil.copy(figure, PAGE.with_name("liggghts.png"))


PAGE, HEAD = shared.ROOT / "docs" / "measurements.md", "## Beside LIGGGHTS\n"
TEXT = """`run/study compare_liggghts` writes this section. [LIGGGHTS](https://www.cfdem.com) 3.8.0 (`apt-get install
liggghts`) is a soft-sphere code; both codes stir the same settled beds, on one core of an {cpu}, commit
{commit}.

{table}

- LIGGGHTS has linear springs and dashpots, kt = 2/7 kn and restitution 0.3. Its steps are a tenth of the contact time:
  0.24 ms with k = 1e7 N/m, 0.077 ms with 1e8.
- Ours is `apgd` with the scene's own stiffness: 5.1e7 N/m at n = 4, 1.4e8 at n = 8, 2.8e8 at n = 16; by default with
  steps of 10 ms (n = 16: 9.2 ms) to 5e-4.
- Positions of the starts differ by 1e-5 m. Seconds are without start-up (median), overlaps the largest in % of a
  radius, torques means after 0.1 s, and the floor bears this part of the weight.
- Within the first 0.4 s of n = 16 the torque of one start is off by up to 10 %.
- LIGGGHTS does better in two ways: there is no tolerance to choose, and its memory is a fifth of ours, most of which is
  Python, PETSc and compiled loops.

![How far the torque is off its limit, over CPU seconds per simulated second; letters are the lines](liggghts.png)

"""


HEAD_OF_CORES = "## Beside LIGGGHTS on two cores\n"
TEXT_OF_CORES = """`run/study compare_liggghts --cores` writes this section: seconds by the clock per
simulated second of the same settled beds, on one rank and on two of an {cpu} of two cores, commit {commit}.
LIGGGHTS has k = 1e8 N/m; ours are the defaults with `apgd`. n = 32 has 274,625 spheres; of it 0.05 s.

{table}

At n = 4 a second rank does not help ours. 0.05 s are few of our steps, and the first ones take longer.

"""


def main() -> None:
    line = shared.parser("compare_liggghts", __doc__)
    line.add_argument("n", type=int, nargs="*", help="sizes of the mixer (4 8 16, with --cores 32 as well)")
    line.add_argument("--seconds", type=shared.listed(float), help="simulated, of each (3,3,1.2; --cores 1,1,0.2,0.05)")
    line.add_argument("--cores", action="store_true", help="one rank and two, by the clock")
    line.add_argument("--starts", type=shared.listed(shared.at_least_one), default="2,2,1", help="of each (2,2,1)")
    usual = "1e7,1e8"
    line.add_argument("--stiffness", type=shared.listed(float), default=usual, help=f"of LIGGGHTS [N/m] ({usual})")
    line.add_argument("--ours", nargs="+", default=OURS, help="settings, see above")
    words = line.parse_args()
    words.n = words.n or ([4, 8, 16, 32] if words.cores else [4, 8, 16])
    words.seconds = words.seconds or ([1.0, 1.0, 0.2, 0.05] if words.cores else [3.0, 3.0, 1.2])
    try:
        _ = [settings_of(setting) for setting in words.ours]
    except ValueError as error:
        line.error(f"--ours {error}")
    if not words.cores and min(words.seconds) <= FORGETS + SAMPLES:
        line.error(f"--seconds {words.seconds}: allowed is more than {FORGETS + SAMPLES}")
    if not shutil.which("liggghts"):
        line.exit(1, "there is no program liggghts on the path; on Debian: apt-get install liggghts\n")
    if not words.cores:
        shared.keep_to_one_core()
    about = shared.say_machine()
    try:
        if words.cores:
            rows = cores(words.n, words.seconds, about)
            if sys.argv[1:] == ["--cores"]:
                write_cores(rows, about)
            return
        sizes = []
        for n, seconds, starts in zip(words.n, cycle(words.seconds), cycle(words.starts)):
            sizes.append(compare(n, seconds, starts, words))
            shared.record("compare_liggghts", about, [row for rows in sizes for row in rows])
    except LiggghtsError as error:
        line.exit(1, f"{error}\n")
    draw(sizes)
    if len(sys.argv) == 1:
        write_page(sizes, about)


if __name__ == "__main__":
    main()
