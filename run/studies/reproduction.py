"""The paper's solver comparison on its three experiments: PDIP seconds, set-up seconds and BiCGStab iterations against
the number of contacts, for no preconditioner, ILU plain and shifted, block Jacobi and tt, all on the same systems."""

from __future__ import annotations

import argparse
from typing import Any

from shared import figure, record, results, say_machine

SCENES = ("mixer", "blade", "shear")
METHODS = {"none": "tab:red", "ilu": "tab:green", "ilu-shifted": "tab:olive", "pbjacobi": "tab:gray", "tt": "tab:blue"}
EVERY = {8: 4, 16: 12}  # Newton systems are sampled at these n, where without a preconditioner one takes up to a minute
HEAD = "| scene | n | contacts | Newton | of them | method | solved | iterations | set-up s | solve s | PDIP s | / tt |"


def measure(scene: str, n: int) -> list[dict[str, Any]]:
    """A row per method: one step of a settled scene. Seconds of a PDIP solve are means over the systems times their
    number."""
    every = EVERY.get(n, 1)
    words = ["-scene", scene, "-scene_n", n, "-restart", "settled", "-steps", 1, "-ccp_type", "pdip"]
    words += ["-dt", 0.025 if scene == "mixer" else 0.01, "-ccp_tol", 1e-4, "-ccp_closing_work", "inf"]
    summary, (step,) = results(1, *words, "-compare", ",".join(METHODS), "-compare_every", every)
    rows = []
    for name, done in summary["compare"].items():
        times = step["newton_its"] / done["systems"]
        rows.append(
            {
                "scene": scene, "n": n, "contacts": step["contacts"], "newton": step["newton_its"],
                "systems": done["systems"], "method": name, "solved": done["converged"],
                "iterations": done["ksp_its_mean"], "setup_s": times * done["setup_s"],
                "solve_s": times * done["solve_s"], "pdip_s": times * (done["setup_s"] + done["solve_s"]),
            }
        )  # fmt: skip
    base = next(row["pdip_s"] for row in rows if row["method"] == "tt")
    return [row | {"ratio": row["pdip_s"] / base} for row in rows]


def line(row: dict[str, Any]) -> str:
    """Of a table in Markdown."""
    cells = [
        row["scene"], row["n"], f"{row['contacts']:,}", row["newton"], row["systems"], f"`{row['method']}`",
        row["solved"], f"{row['iterations']:.0f}", f"{row['setup_s']:.3g}", f"{row['solve_s']:.3g}",
        f"{row['pdip_s']:.3g}", f"{row['ratio']:.3g}",
    ]  # fmt: skip
    return "| " + " | ".join(map(str, cells)) + " |"


def draw(rows: list[dict[str, Any]]) -> None:
    """As in the paper: seconds of a PDIP solve with the part of set-ups, set-ups alone, iterations, against Nc."""
    with figure("reproduction", 3, 3) as axes:
        for i, panel in enumerate(axes):
            scene, what = SCENES[i // 3], ("pdip_s", "setup_s", "iterations")[i % 3]
            for method, colour in METHODS.items():
                points = [row for row in rows if (row["scene"], row["method"]) == (scene, method)]
                x, y = [row["contacts"] for row in points], [max(row[what], 1e-4) for row in points]
                panel.loglog(x, y, "o-", color=colour, label=method)
            words = {"pdip_s": "PDIP solve [s]", "setup_s": "set-ups of a PDIP solve [s]"}
            panel.set(title=scene, xlabel="contacts", ylabel=words.get(what, "mean BiCGStab iterations"))
            panel.grid(alpha=0.3)
            panel.legend()


def main() -> None:
    parser = argparse.ArgumentParser(prog="run/study reproduction", description=__doc__)
    parser.add_argument("-n", type=int, nargs="*", default=[2, 3, 4, 8], help="sizes of all three scenes")
    parser.add_argument("-large", type=int, nargs="*", default=[16], help="sizes of the mixer alone")
    options = parser.parse_args()
    about, rows = say_machine(), list[dict[str, Any]]()
    print(HEAD + "\n" + "|---" * (HEAD.count("|") - 1) + "|", flush=True)
    for scene, n in [(scene, n) for n in options.n for scene in SCENES] + [("mixer", n) for n in options.large]:
        new = measure(scene, n)
        print("\n".join(map(line, new)), flush=True)
        rows += new
        record("reproduction", about, rows)
    draw(rows)


if __name__ == "__main__":
    main()
