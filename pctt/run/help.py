"""What ``python -m pctt.run -help`` prints: the options of the registry, by topic."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from pctt import ccp
from pctt.options import OptionError, describe
from pctt.run.options import option_groups
from pctt.run.settings import DEMO, find_scene

NEWTON_HELP = """\
  The KSP without prefix, e.g. -ksp_type bcgs -ksp_max_it 1000 -ksp_pc_side right -pc_type pbjacobi (the defaults of
  pdip), -ksp_rtol 1e-3 (in place of a tolerance that follows the accuracy of the step), -ksp_monitor, -ksp_view,
  -log_view. A compared preconditioner NAME has the prefix -compare_NAME_, e.g. -compare_ilu_pc_factor_levels 1. On
  several ranks ilu and icc work within each rank. Any of them without -ccp_type takes pdip. PETSc shows these KSPs
  with their prefix ccp_ (-ccp_ksp_type is the same option)."""
TOPICS = {"run": "the run itself", "scene": "the scene of -scene", "ccp": "cone problems and their solvers",
          "pc": "preconditioners of this package", "ksp": "Newton systems"}  # fmt: skip


def help_text(database: Mapping[str, str], topic: str = "") -> str:
    """Options with default, unit and meaning, of one of TOPICS or of all; OptionError for another topic."""
    if topic and topic not in TOPICS:
        raise OptionError(f"-help {topic}: there is no such topic; allowed are {', '.join(TOPICS)}, or none for all")
    lines = ["Options of pctt.run (names <default unit>: meaning); without any, it runs the demo:"]
    lines += ["  " + " ".join(f"-{name} {value}" for name, value in DEMO.items())]
    lines += ["Of one topic: " + ", ".join(f"-help {name} ({text})" for name, text in TOPICS.items()), ""]
    for part, title, text in _help_sections(database):
        if topic in ("", part):
            lines += [title, text, ""] if text else [title]
    return "\n".join(lines[4:] if topic else lines).rstrip()


def _help_sections(database: Mapping[str, str]) -> Iterator[tuple[str, str, str]]:
    """Topic, title and text of each section of the help."""
    scene = database.get("scene", "mixer")
    titles = ["Run", f"Scene {scene}", "Cone problem"]
    titles += [f"-ccp_type {name}: {solver.help}" for name, solver in ccp.SOLVERS.items()]
    for title, (group, prefix) in zip(titles, option_groups(find_scene(scene))):
        topic = prefix.partition("_")[0] or "run"  # the first word of the options
        yield topic, title, "\n".join(map(str, describe(group, prefix)))
    from pctt.pc import BlockICC, TensorTrain  # here, as their import would slow down every start

    for kind in (BlockICC, TensorTrain):
        described = "\n".join(map(str, describe(kind.options_class, kind.options_prefix)))
        yield "pc", f"-pc_type python -pc_python_type {kind.name}", described
    yield "ksp", "Newton systems", NEWTON_HELP
