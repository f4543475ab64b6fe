"""The documentation site: what it says of the code is complete, and a browser shows all of it, on a phone too."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import re
import subprocess
import sys
from pathlib import Path

import browser
import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
TOOLS = ("sphinx", "furo", "myst_parser", "sphinx_copybutton", "sphinx_design", "sphinx-mathjax-offline")
MISSING = [name for name in TOOLS if not importlib.util.find_spec(name)]
WIDTHS = {400: 300, 1400: 180}  # of the window, and of the narrowest column of text [pixels]
#: What users look for, and a page that tells of it; it comes among the first three.
WORDS = {
    "belt": "loads", "motor": "loads", "torque": "loads", "restart": "scenes", "feeder": "sources", "joint": "loads",
    "periodic": "periodic", "cohesion": "contact_laws", "rolling": "contact_laws", "stiffness": "mechanics",
    "restitution": "mechanics", "STL": "scenes", "ParaView": "looking", "film": "looking", "Slurm": "cluster",
    "wheel": "loads", "clump": "scenes", "spring": "loads", "stress": "measuring", "checkpoint": "scenes",
    "overlap": "mechanics", "closing work": "accuracy", "notebook": "python", "friction": "contact_laws",
    "preconditioner": "preconditioners", "friction coefficient": "contact_laws", "dt": "choose", "VTK": "looking",
    "coefficient of restitution": "mechanics", "time step": "choose", "angle of repose": "glossary", "MPI": "cluster",
    "LIGGGHTS": "measurements", "MuJoCo": "mujoco", "Clarabel": "problems", "PETSc options": "options",
    "units": "glossary", "Coulomb": "ccp", "PETSc": "preconditioners", "threads": "cluster", "tolerance": "choose",
    "BlockICC": "made/api/pctt.pc.BlockICC", "Hinged": "made/api/dem.motion.Hinged",
}  # fmt: skip


@pytest.fixture
def pages(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS))
    return importlib.import_module("pages")


# -- what the pages are made of ------------------------------------------------------------------------------


def test_the_reference_has_all_public_modules_and_names(pages):
    listed = [name for names in pages.PARTS.values() for name in names]
    dem = importlib.import_module("dem")
    assert {*dem.__all__} == {name.split(".")[1] for name in listed if name.startswith("dem.")}
    packages = ["pctt", "pctt.ccp", "pctt.ccp.fclib", "pctt.mat", "pctt.pc", "pctt.tt", "dem.measures", "dem.contact"]
    for name in packages:
        assert set(pages.public(name)) == set(importlib.import_module(name).__all__)
    assert len(pages.homes()) == len(set(pages.homes()))


def test_every_public_class_has_an_example(pages):
    classes = {name for name, thing in pages.homes().items() if inspect.isclass(thing)}
    assert classes == set(pages.cells())  # docs/api_examples.py


def test_docstrings_with_sections_have_no_lists_outside_of_them(pages):
    """docs/conf.py makes fields of "name : meaning" where there are no sections; elsewhere numpydoc needs a heading."""
    for name, thing in pages.homes().items():
        before, dashes, _ = (inspect.getdoc(thing) or "").partition("\n---")
        assert not dashes or not re.search(r"^[a-z]\w*(, \w+)* : ", before, re.MULTILINE), name


def test_all_options_are_in_the_tables(pages):
    from pctt.run.help import help_text

    text = pages.options()
    assert set(re.findall(r"^  -(\w+) <", help_text({}), re.MULTILINE)) <= set(re.findall(r"`-(\w+)`", text))


def test_messages_of_the_troubleshooting_are_those_of_the_code():
    source = "".join(path.read_text() for part in ("dem", "pctt") for path in (ROOT / part).rglob("*.py"))
    messages = re.findall(r"^### `(.+)`$", (DOCS / "faq.md").read_text(), re.MULTILINE)
    assert len(messages) > 15
    assert [message for message in messages if message not in source] == []


# -- the built site ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The built site, opened as files, so without a server or a network, and a browser."""
    if MISSING or not browser.CHROMIUM:
        pytest.skip(f"needs {', '.join(MISSING) or 'Chromium'}; run/docs installs the tools of the extra `docs`")
    folder = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html", str(DOCS), str(folder)]
    done = subprocess.run(build, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    page = browser.Browser(tmp_path_factory.mktemp("profile"))
    yield folder, folder.as_uri(), page
    page.close()


#: Cells of tables with more than ten words, and no formulas, that are narrower than so many pixels.
NARROW = """[...document.querySelectorAll('td')].filter(cell => cell.innerText.split(/\\s+/).length > 10
    && !cell.querySelector('mjx-container') && cell.getBoundingClientRect().width < {}).length"""


@pytest.mark.slow
@pytest.mark.parametrize("width", WIDTHS)
def test_no_page_overflows_or_shows_raw_formulas(site, width):
    folder, address, page = site
    page.errors.clear()
    bad = {}
    for path in sorted(folder.rglob("*.html")):
        name = str(path.relative_to(folder))
        if name.startswith(("_modules", "genindex", "py-modindex")):
            continue
        page.open(f"{address}/{name}", width)
        overflow = page.value("document.documentElement.scrollWidth - window.innerWidth")
        text = page.value("document.querySelector('article').innerText") or ""
        raw = re.findall(r"\\\(|\\\[|\$\$|\\mathrm|\\frac", text)
        narrow, errors = page.value(NARROW.format(WIDTHS[width])), list(page.errors)
        page.errors.clear()
        raw = [] if "api" in name else raw  # docstrings of trains show backslashes of arrays
        if overflow > 0 or raw or narrow or errors:
            bad[name] = (overflow, raw, narrow, errors)
    assert bad == {}


@pytest.mark.slow
def test_formulas_need_no_network(site):
    folder, address, page = site
    assert not re.findall(r'<script[^>]+src="https?:', (folder / "ccp.html").read_text())
    page.open(f"{address}/ccp.html", 1400)
    assert page.value("document.querySelectorAll('mjx-container svg').length") > 20


@pytest.mark.slow
def test_the_search_finds_the_words_of_users(site):
    _, address, page = site
    page.errors.clear()
    results = "[...document.querySelectorAll('#search-results li a')].map(link => link.getAttribute('href'))"
    missed = {}
    for word, wanted in WORDS.items():
        page.open(f"{address}/search.html?q={word.replace(' ', '+')}", 1400)
        found = page.value(f"""new Promise(done => {{ const look = () => {{
            const all = {results};
            const said = document.querySelector('#search-results p.search-summary')?.innerText;
            if (said?.match(/\\d|one page|not match/)) done(all);
            else setTimeout(look, 50); }}; look(); }})""")
        if not any(link.startswith(f"{wanted}.html") for link in found[:3]):
            missed[word] = found[:3]
    assert missed == {}
    assert page.errors == []


@pytest.mark.slow
def test_every_page_has_the_version(site):
    folder, *_ = site
    import pctt

    files = [path for path in folder.rglob("*.html") if "_modules" not in str(path)]
    assert [path for path in files if f"pctt {pctt.__version__}" not in path.read_text()] == []
