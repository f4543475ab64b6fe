"""Pages that are made of the code when the site is built: options, gallery, reference. They go to docs/made."""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import inspect
import io
import json
import os
import re
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import FunctionType
from typing import Any

from pctt import ccp
from pctt.options import Description, describe
from pctt.pc import BlockICC, TensorTrain
from pctt.run.settings import Run, Settings
from pctt.scenes import SCENES

DOCS = Path(__file__).resolve().parent
EXAMPLES = DOCS / "examples"
HELPERS = {"integral_problems", "comparison"}  # files that examples import

#: The public modules by what they are for. Of a package its __all__ is public, of another module all that it defines.
PARTS = {
    "Simulations and their results": ["pctt", "pctt.simulation", "pctt.folder", "pctt.analysis", "dem.measures"],
    "What a scene is made of": [
        "dem.scene", "dem.shapes", "dem.mesh", "dem.motion", "dem.parts.contact_law", "dem.parts.loads",
        "dem.parts.springs", "dem.parts.joints", "dem.parts.sources", "dem.parts.cell", "dem.packing", "pctt.beds",
        "dem.experiment",
        "pctt.scenes", "dem.start.stiffness", "dem.start.time_step", "dem.checks", "dem.record.analysis",
    ],
    "What a time step is made of": [
        "dem.start", "dem.model.world", "dem.bodies", "dem.unconstrained", "dem.contact", "dem.step.system",
        "dem.contact_map", "dem.step", "dem.step.impulses", "dem.record", "dem.model.partition",
        "dem.model.neighbourhood",
    ],
    "Cone problems": ["pctt.ccp", "pctt.ccp.fclib"],
    "Preconditioners and tensor trains": ["pctt.pc", "pctt.mat", "pctt.tt"],
    "Options": ["pctt.options"],
}  # fmt: skip
#: What is public of modules that define helpers of other modules too.
ONLY = {
    "pctt.simulation": ["Body"],
    "pctt.beds": ["read_spheres"],
    "dem.scene": ["LargeBody", "Scene"],
    "dem.unconstrained": ["UnconstrainedMotion", "unconstrained"],
    "dem.shapes": [
        "Plane", "Box", "Sphere", "Capsule", "Cylinder", "Superellipsoid", "Clump", "described", "placed", "solid",
        "solid_properties", "mass_properties", "moved",
    ],
    "dem.mesh": ["Mesh"],
    "dem.motion": ["Dynamic", "Fixed", "Glide", "Guided", "Held", "Hinged", "Oscillation", "Path", "Rotation"],
    "dem.parts.loads": ["Load"],
    "dem.parts.springs": ["Spring"],
    "dem.parts.joints": ["Joint"],
    "dem.parts.cell": ["Cell"],
}


def public(name: str) -> dict[str, Any]:
    """The public names of a module and what they are."""
    module = importlib.import_module(name)
    names = ONLY.get(name) or getattr(module, "__all__", None)
    if names is None:
        defined = [key for key, value in vars(module).items() if getattr(value, "__module__", "") == name]
        names = [key for key in defined if isinstance(getattr(module, key), (type, FunctionType))]
    return {key: getattr(module, key) for key in names if not key.startswith("_")}


def homes() -> dict[str, Any]:
    """All public classes and functions by their full names, of each the first; `pctt` has names of all others, too."""
    found: dict[str, Any] = {}
    for module in sorted((name for names in PARTS.values() for name in names), key=lambda name: name == "pctt"):
        for key, value in public(module).items():
            if (inspect.isclass(value) or inspect.isfunction(value)) and value not in found.values():
                found[f"{module}.{key}"] = value
    return found


def first_line(thing: Any) -> str:
    """The first sentence of a docstring, in Markdown."""
    text = " ".join((inspect.getdoc(thing) or "").split("\n\n")[0].split())
    text = text.split(". ")[0].rstrip(".:").replace("``", "`")
    return re.sub(r"([|*<])", r"\\\1", text)


# -- reference ----------------------------------------------------------------------------------------------


def cells() -> dict[str, str]:
    """The programs of api_examples.py by the names of the classes that each is about."""
    parts = (DOCS / "api_examples.py").read_text().split("\n# %% ")[1:]
    found = {name: code for names, _, code in (part.partition("\n") for part in parts) for name in names.split(", ")}
    for star in [name for name in found if name.endswith("*")]:
        code = found.pop(star)
        found |= {name: code for name in homes() if name.startswith(star[:-1])}
    return found


def run(code: str) -> tuple[str, float]:
    """What a program prints, and its CPU seconds. It runs in a folder of its own."""
    before, printed = os.getcwd(), io.StringIO()
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(printed), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        os.chdir(folder)
        start = time.process_time()
        try:
            exec(compile(code, "api_examples.py", "exec"), {"__name__": "__main__"})
        finally:
            os.chdir(before)
    return printed.getvalue(), time.process_time() - start


def outputs() -> dict[str, tuple[str, float]]:
    """What the programs print, and their seconds. They run again when they, or code of the project, have changed."""
    sources = [path.read_bytes() for part in ("dem", "pctt") for path in sorted((DOCS.parent / part).rglob("*.py"))]
    of, kept = hashlib.sha256(b"".join(sources)).hexdigest(), DOCS / "made" / "outputs.json"
    known = json.loads(kept.read_text()) if kept.exists() else {}
    known = known["outputs"] if known.get("of") == of else {}
    known = {code: known.get(code) or run(code) for code in cells().values()}
    kept.parent.mkdir(exist_ok=True)
    kept.write_text(json.dumps({"of": of, "outputs": known}))
    return known


def reference() -> Iterator[tuple[str, str]]:
    """Names and texts of the pages: one of each module, and one of each class."""
    classes, examples, done = homes(), cells(), outputs()
    for module in (name for names in PARTS.values() for name in names):
        rows, functions, constants = [], [], []
        for key, value in public(module).items():
            home = next((name for name, thing in classes.items() if thing is value), "")
            if inspect.isclass(value):
                rows.append(f"| [`{key}`]({home}.md) | {first_line(value)} |")
                if home == f"{module}.{key}":
                    code = examples.get(home, "")
                    yield home, class_page(home, code, *done.get(code, ("", 0.0)))
            elif inspect.isfunction(inspect.unwrap(value)):  # also of one that is compiled
                functions.append(f".. autofunction:: {module}.{key}")
            elif not inspect.ismodule(value):
                values = [value] if isinstance(value, str) else value
                constants.append(f"| `{key}` | {', '.join(f'`{one}`' for one in values)} |")
        text = [f"# `{module}`", "```{eval-rst}", f".. automodule:: {module}", "   :no-members:", "```", ""]
        if rows:
            text += ["| class | |", "|---|---|", *rows, ""]
        if functions:
            text += ["## Functions", "```{eval-rst}", *functions, "```"]
        if constants:
            text += ["", "## Constants", "| name | is, or has |", "|---|---|", *constants]
        yield module, "\n".join(text) + "\n"


def class_page(name: str, code: str, printed: str, seconds: float) -> str:
    """The page of a class: an example with its output, then what the docstrings say."""
    module, _, short = name.rpartition(".")
    text = f"# {short}\n\nA class of [`{module}`]({module}.md).\n\n"
    if code:
        text += f"```python\n{code.strip()}\n```\nprints, in {max(seconds, 0.01):.2g} CPU s,\n\n"
        text += f"```text\n{printed.rstrip()}\n```\n\n"
    undocumented = "" if (inspect.getdoc(homes()[name]) or "") else "   :undoc-members:\n"
    return text + f"```{{eval-rst}}\n.. autoclass:: {name}\n{undocumented}```\n"


def contents() -> str:
    """The list of all modules, by what they are for."""
    text = ""
    for title, modules in PARTS.items():
        text += f"## {title}\n\n| module | |\n|---|---|\n"
        for name in modules:
            text += f"| [`{name}`](made/api/{name}.md) | {first_line(importlib.import_module(name))} |\n"
        text += "\n"
    everything = [*(name for names in PARTS.values() for name in names)]
    classes = [name for name, thing in homes().items() if inspect.isclass(thing)]
    order = sorted([*everything, *classes])
    return text + "```{toctree}\n:hidden:\n" + "\n".join(f"made/api/{name}" for name in order) + "\n```\n"


# -- options ------------------------------------------------------------------------------------------------


def rows_of(options: list[Description], of: str = "") -> str:
    """A table of options, each with an anchor: `opt-dt` of -dt, `opt-mixer-scene_n` of the scene mixer."""
    text = "| option | default | unit | meaning |\n|---|---|---|---|\n"
    for option in options:
        default = str(option.default).lower() if isinstance(option.default, bool) else option.default
        default = f"{default:g}" if isinstance(default, float) else "none" if default in (None, "") else default
        choices = ", ".join(f"`{choice}`" for choice in option.choices)
        meaning = (option.help + f"; one of {choices}" * bool(choices)).replace("|", r"\|")
        text += f"| [`-{option.name}`]{{#opt-{of}{option.name}}} | {default} | {option.unit} | {meaning} |\n"
    return text + "\n"


def options() -> str:
    """All options of the program, a table for each group."""
    text = "## The run\n" + rows_of(describe(Run)) + "## Time steps and solvers\n" + rows_of(describe(Settings, "ccp_"))
    text += "## Of one solver\nThe other solvers have no options of their own.\n\n"
    for name, solver in ccp.SOLVERS.items():
        if described := describe(solver.options, solver.prefix):
            text += f"### `-ccp_type {name}`: {solver.help}\n" + rows_of(described)
    for kind in (BlockICC, TensorTrain):
        text += f"## Preconditioner `{kind.name}`\n" + rows_of(describe(kind.options_class, kind.options_prefix))
    text += "## Scenes\n"
    for name, scene in SCENES.items():
        text += f"### `-scene {name}`\n{first_line(scene)} ([page](scenes.md)).\n\n"
        text += rows_of(describe(scene, "scene_"), name + "-")
    return text


# -- gallery ------------------------------------------------------------------------------------------------


def gallery() -> str:
    """Cards of all scenes and examples: picture, what it is, lines, CPU seconds."""
    took = json.loads((DOCS / "gallery.json").read_text())
    text = "## Scenes of the package\n" + grid(
        card(name, f"{name}.png", "scenes.md", inspect.getsourcefile(scene), first_line(scene),
             took.get(f"scenes/{name}"))
        for name, scene in SCENES.items()
    )  # fmt: skip
    files = sorted(path for path in EXAMPLES.glob("*.py") if path.stem not in HELPERS)
    heads = {path.stem: path.read_text().split('"""')[1].partition("\n\n")[0] for path in files}
    files.append(EXAMPLES / "simulation.ipynb")
    heads["simulation"] = "A stirrer turns in a bed of spheres, in a notebook"
    text += "## Examples\n" + grid(
        card(path.stem, f"examples/{path.stem}.png", f"examples/{path.name}", path,
             " ".join(heads[path.stem].split()).removesuffix("::").split(":")[0], took.get(f"examples/{path.stem}"))
        for path in files
    )  # fmt: skip
    return text


def grid(cards: Iterator[str]) -> str:
    """Cards side by side: one column on a phone, three on a desk."""
    return "::::{grid} 1 2 3 3\n:gutter: 3\n\n" + "".join(cards) + "::::\n\n"


def card(name: str, picture: str, link: str, source: Any, about: str, seconds: float | None) -> str:
    """A picture with a line of text; what was not drawn yet has neither picture nor seconds."""
    lines = len(Path(source).read_text().splitlines())
    shown = f":img-top: {picture}\n:img-alt: {name}\n" if (DOCS / picture).exists() else ""
    cost = f", {seconds:.3g} CPU s" if seconds else ""
    return f":::{{grid-item-card}} [{name}]({link})\n{shown}\n{about}. *{lines} lines{cost}*\n:::\n"


# -- all ----------------------------------------------------------------------------------------------------


def write(docs: Path) -> None:
    """Write the pages; what has not changed is left alone, so that Sphinx reads only what is new."""
    texts = {"options": options(), "gallery": gallery(), "reference": contents()}
    texts |= {f"api/{name}": text for name, text in reference()}
    made = docs / "made"
    for path in made.rglob("*.md"):
        if str(path.relative_to(made))[:-3] not in texts:
            path.unlink()
    for name, text in texts.items():
        path = made / f"{name}.md"
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists() or path.read_text() != text:
            path.write_text(text)
