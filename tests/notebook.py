"""Notebooks without Jupyter: run the cells of a file in the format nbformat 4, and write their outputs into it anew::

    python tests/notebook.py docs/examples/simulation.ipynb
"""

from __future__ import annotations

import ast
import base64
import contextlib
import io
import json
import sys
from pathlib import Path
from typing import Any

RICH = {"text/html": "_repr_html_", "image/png": "_repr_png_"}


def run(path: Path, skipped: tuple[str, ...] = ()) -> tuple[dict[str, Any], dict[str, Any]]:
    """The notebook with the outputs of its cells, and the names that they leave. Cells with a tag of `skipped` stay as
    they are."""
    notebook, names = json.loads(path.read_text()), {"__name__": "__main__"}
    codes = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    for number, cell in enumerate(codes, 1):
        if not set(skipped) & set(cell["metadata"].get("tags", [])):
            cell["execution_count"], cell["outputs"] = number, _outputs("".join(cell["source"]), number, names)
    return notebook, names


def _outputs(source: str, number: int, names: dict[str, Any]) -> list[dict[str, Any]]:
    """What a cell prints, and the value of its last line if that is an expression."""
    tree, value = ast.parse(source), None
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile(tree, f"cell {number}", "exec"), names)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), f"cell {number}", "eval"), names)
    outputs: list[dict[str, Any]] = []
    if printed.getvalue():
        lines = printed.getvalue().splitlines(keepends=True)
        outputs.append({"output_type": "stream", "name": "stdout", "text": lines})
    if value is not None:
        data = {"text/plain": [repr(value)]}
        for kind, method in RICH.items():
            if hasattr(value, method):
                rich = getattr(value, method)()
                data[kind] = [rich] if isinstance(rich, str) else base64.b64encode(rich).decode()
        outputs.append({"output_type": "execute_result", "execution_count": number, "metadata": {}, "data": data})
    return outputs


if __name__ == "__main__":
    for file in map(Path, sys.argv[1:]):
        file.write_text(json.dumps(run(file)[0], indent=1) + "\n")
