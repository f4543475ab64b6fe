"""Scenes of few bodies, and the stirred mixer, by MuJoCo and by `pctt.Simulation` on the same core:

    run/study compare_mujoco [N ...] [--seconds S] [--starts M]

MuJoCo is not part of this project: .venv/bin/pip install mujoco.

Few bodies rest on a floor, or hang on a ball joint, in steps of 2 ms; milliseconds of the processor are the least of
ten blocks of steps, after steps that do not count. The mixers, of sizes N, start from the same settled beds; what is
measured of them is what `compare_liggghts` measures. MuJoCo takes steps of 2 ms, the stiffest contacts that they bear
(solref of two steps, solimp of 0.99), elliptic cones and the method CG with two tolerances; its own defaults of both
are softer. Its paddle is a hinge whose speed is set in each step.

Writes results/compare_mujoco.json, and without words (five minutes) a section of docs/mujoco.md.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np
import shared
from compare_liggghts import SAMPLES, Course, Start, ours, peak_memory, row, start_of
from shared import Row, Table

import pctt
from dem.motion import Dynamic
from dem.scene import Scene
from dem.shapes import Plane, Sphere

try:
    import mujoco
except ImportError:
    mujoco = None

DT = 0.002  # [s]
BLOCKS, FIRST = 10, 60
RADIUS, FRICTION, DENSITY = 0.1, 0.5, 1000.0
FEW = {"1 sphere": 1, "100 spheres": 100, "1 box": 1, "10 boxes": 10, "100 boxes": 100, "a pendulum": 1}
TOLERANCES = (1e-5, 1e-8)  # of MuJoCo's solver
SPHERE, PADDLE, WALL = 'contype="1" conaffinity="7"', 'contype="2" conaffinity="0"', 'contype="4" conaffinity="0"'


# -- few bodies ---------------------------------------------------------------------------------------------------


def places(count: int) -> np.ndarray:
    """Centres (count, 3) of bodies that rest side by side on the floor and on one another."""
    side = int(np.ceil(count ** (1 / 3)))
    return np.indices((side,) * 3).reshape(3, -1).T[:count] * 2.1 * RADIUS + [0, 0, RADIUS]


def few_of_ours(name: str) -> Scene:
    scene = Scene(friction=FRICTION)
    scene.add_body("floor", [Plane((0, 0, 1))])
    if name == "a pendulum":
        scene.add_body("bob", [Sphere(RADIUS)], position=(0.3, 0, 1), density=DENSITY, motion=Dynamic())
        scene.add_joint("pivot", "bob", kind="ball", anchor=(0, 0, 1))
    elif "box" in name:
        scene.add_boxes(places(FEW[name]), [RADIUS] * 3, DENSITY)
    else:
        scene.add_spheres(places(FEW[name]), RADIUS, DENSITY)
    return scene


def few_of_theirs(name: str) -> str:
    kind = 'type="box" size="0.1 0.1 0.1"' if "box" in name else 'type="sphere" size="0.1"'
    geom = f'<geom {kind} density="{DENSITY}" friction="{FRICTION}"/>'
    if name == "a pendulum":
        bodies = f'<body pos="0.3 0 1"><joint type="ball" pos="-0.3 0 0"/>{geom}</body>'
    else:
        bodies = "".join(f'<body pos="{x} {y} {z}"><freejoint/>{geom}</body>' for x, y, z in places(FEW[name]))
    floor = f'<geom type="plane" size="10 10 1" friction="{FRICTION}"/>'
    return f'<mujoco><option timestep="{DT}"/><worldbody>{floor}{bodies}</worldbody></mujoco>'


def milliseconds(step: Any, steps: int) -> float:
    """Of the processor for a step: the least mean of the blocks of so many steps."""
    for _ in range(FIRST):
        step()
    means = []
    for _ in range(BLOCKS):
        before = time.process_time()
        for _ in range(steps):
            step()
        means.append((time.process_time() - before) / steps)
    return 1e3 * min(means)


def few(name: str) -> Row:
    steps = 20 if FEW[name] == 100 else 100
    with pctt.Simulation(few_of_ours(name), dt=DT) as sim:
        own = milliseconds(sim.step, steps)
    model = mujoco.MjModel.from_xml_string(few_of_theirs(name))
    data = mujoco.MjData(model)
    return {"scene": name, "theirs": milliseconds(lambda: mujoco.mj_step(model, data), steps), "ours": own}


# -- the mixer ----------------------------------------------------------------------------------------------------


def mixer_of_theirs(start: Start, tolerance: float) -> str:
    mixer, wall = start.mixer, start.mixer.width / 2
    numbers = [" ".join(map(str, x)) for x in start.position]
    sphere = f'<geom type="sphere" size="{mixer.radius}" density="{mixer.density}" {SPHERE}/>'
    ways = {"-1 0 0": f"{wall} 0 0", "1 0 0": f"-{wall} 0 0", "0 -1 0": f"0 {wall} 0", "0 1 0": f"0 -{wall} 0"}
    walls = [f'<geom type="plane" size="9 9 1" pos="{at}" zaxis="{way}" {WALL}/>' for way, at in ways.items()]
    half, turn = " ".join(map(str, start.half)), np.degrees(start.angle)
    return f"""<mujoco>
        <compiler angle="degree"/>
        <option timestep="{DT}" gravity="0 0 {-mixer.gravity}" cone="elliptic" jacobian="sparse" solver="CG"
            tolerance="{tolerance}" iterations="1000"/>
        <size memory="4G"/>
        <default><geom condim="3" friction="{mixer.friction}" solref="{2 * DT} 1" solimp="0.99 0.99 0.001"/></default>
        <worldbody>
            <geom type="plane" size="9 9 1" {WALL}/>{"".join(walls)}
            <body pos="0 0 {start.middle}" euler="0 0 {turn}">
                <joint type="hinge" axis="0 0 1" armature="1e7"/><geom type="box" size="{half}" mass="1" {PADDLE}/>
            </body>
            {"".join(f'<body pos="{at}"><freejoint/>{sphere}</body>' for at in numbers)}
        </worldbody></mujoco>"""


def theirs(n: int, seed: int, seconds: float, tolerance: float) -> Course:
    """A run of MuJoCo; the first of its joints is that of the paddle, its first geometry the floor."""
    start = start_of(n, seed)
    model = mujoco.MjModel.from_xml_string(mixer_of_theirs(start, tolerance))
    data = mujoco.MjData(model)
    moving = data.qvel[1:].reshape(-1, 6)  # the spin is in the frame of the body, which is the world's at the start
    moving[:] = start.velocity
    spent, every, rows, samples = 0.0, round(SAMPLES / DT), [], []
    for step in range(1, round(seconds / DT) + 1):
        data.qvel[0] = start.mixer.angular_velocity
        before = time.process_time()
        mujoco.mj_step(model, data)
        spent += time.process_time() - before
        contact = data.contact
        floor = contact.efc_address[(contact.geom == 0).any(axis=1)]
        rows.append((step * DT, -data.qfrc_constraint[0], data.efc_force[floor[floor >= 0]].sum()))
        if step % every == 0:
            samples.append((step * DT, data.qpos[1:].reshape(-1, 7)[:, :3].copy()))
    return Course(*np.array(rows).T, samples, spent, peak_memory("self"), 0)


def stirred(n: int, seconds: float, starts: int) -> list[Row]:
    start = start_of(n, 0)
    ways = {f"MuJoCo, CG to {tolerance:.0e}": (theirs, tolerance) for tolerance in TOLERANCES} | {"pctt": (ours, {})}
    about = {"n": n, "spheres": len(start.position), "seconds": seconds, "starts": starts}
    found = []
    for name, (run, setting) in ways.items():
        courses = [shared.in_new_process(run, n, seed, seconds, setting) for seed in range(starts)]
        found.append(about | {"code": name} | row(start, seconds, courses))
    return found


# -- the page -----------------------------------------------------------------------------------------------------


def write_page(small: list[Row], large: list[Row], about: Row) -> None:
    """The section of docs/mujoco.md."""
    heads = ["CPU ms of a step of 2 ms", *(each["scene"] for each in small)]
    lines = [[code, *(f"{each[key]:.2g}" for each in small)] for code, key in (("MuJoCo", "theirs"), ("pctt", "ours"))]
    rows: list[list[str]] = []
    for k, each in enumerate(large):
        begins = f"{each['spheres']:,} spheres, {each['starts']} x {each['seconds']:g} s"
        torque = f"{each['torque']:.1f} ± {each['torque_error']:.1f}"
        figures = f"{each['cpu']:.3g}", f"{each['overlap']:.1f}", torque, f"{each['floor']:.3f}"
        rows.append(["" if k and each["n"] == large[k - 1]["n"] else begins, each["code"], *figures])
    columns = "CPU s/s", "overlap, %", "torque, kN m", "floor"
    tables = shared.markdown(heads, lines), shared.markdown(["mixer", "", *columns], rows)
    words = {"cpu": about["cpu"], "commit": shared.commit(), "mujoco": mujoco.__version__}
    shared.replace_section(PAGE, HEAD, TEXT.format(few=tables[0], mixer=tables[1], **words))


PAGE, HEAD = shared.ROOT / "docs" / "mujoco.md", "## What a step costs\n"
TEXT = """`run/study compare_mujoco` writes this section: MuJoCo {mujoco} and the defaults here, one core of an {cpu},
commit {commit}.

{few}

The mixer stirs the same settled beds. MuJoCo has the stiffest contacts that its steps of 2 ms bear; the torque is a
mean after 0.1 s, the overlap the worst in % of a radius, and the floor bears this part of the weight.

{mixer}

"""


def main() -> None:
    line = shared.parser("compare_mujoco", __doc__)
    line.add_argument("n", type=int, nargs="*", help="sizes of the mixer (4 8)")
    line.add_argument("--seconds", type=float, default=0.5, help="simulated, of each (0.5)")
    line.add_argument("--starts", type=shared.at_least_one, default=2, help="of each (2)")
    words = line.parse_args()
    if mujoco is None:
        line.exit(1, "there is no MuJoCo: .venv/bin/pip install mujoco\n")
    shared.keep_to_one_core()
    about = shared.say_machine()
    table = Table(scene=("scene", "<12"), MuJoCo_ms=("theirs", "9.3g"), pctt_ms=("ours", "8.3g"))
    small = []
    for name in FEW:
        small.append(few(name))
        table.add(small[-1])
    table = Table(
        n=("n", "3d"), code=("code", "<20"), CPU_s_per_s=("cpu", "11.2f"), overlap=("overlap", "7.2f"),
        torque_kN_m=("torque", "11.2f"), error=("torque_error", "5.2f"), floor=("floor", "6.3f"),
        MiB=("memory", "6.0f"),
    )  # fmt: skip
    large = []
    for n in words.n or [4, 8]:
        for each in stirred(n, words.seconds, words.starts):
            large.append(each)
            table.add(each)
        shared.record("compare_mujoco", about, small + large)
    if len(sys.argv) == 1:
        write_page(small, large, about)


if __name__ == "__main__":
    main()
