"""Sphinx extension: pages that are made from the package itself, before every build.

It writes into ``docs/generated``: a page per environment, the gallery of presets, the
table of a scenario's fields, and the lists of public names.
"""

import importlib
import inspect
import re
import sys
from pathlib import Path
from types import ModuleType

import preset_pictures
import scenario_fields
from sphinx.application import Sphinx
from sphinx.config import Config
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.display import status_iterator

import slamgym
from slamgym import agents, envs, estimator, evaluation, experiments, sim_configs

ROOT = Path(__file__).parents[2]
ENVIRONMENTS = {
    "LandmarkWorld": (envs.LandmarkWorldEnv, "loop"),
    "ActiveSlam": (agents.ActiveSlamEnv, "active_medium"),
}
PACKAGES: tuple[ModuleType, ...] = (
    estimator,
    evaluation,
    sim_configs,
    envs,
    agents,
    experiments,
    slamgym,
)
"""A name stands under the first package that has it."""


def setup(app: Sphinx) -> dict[str, bool]:
    """Register with Sphinx."""
    app.connect("config-inited", write_pages)  # before Sphinx lists the pages
    app.connect("source-read", point_into_the_site)
    return {"parallel_read_safe": True}


def write_pages(app: Sphinx, config: Config) -> None:
    """Write all pages below ``docs/generated``."""
    folder = Path(app.srcdir) / "generated"
    (folder / "api").mkdir(parents=True, exist_ok=True)
    for name, (environment, preset) in ENVIRONMENTS.items():
        _write(folder / f"{name}.md", environment_page(name, environment, preset))
        if not (picture := folder / f"{name}.gif").exists():
            preset_pictures.film(name, preset, picture)
    _write(folder / "fields.md", scenario_fields.page())
    _write(folder / "examples.md", examples_page())
    _write(folder / "presets.md", preset_pictures.page(folder))
    listed = public_names()
    for package in status_iterator(listed, "listing public names … "):
        _write(folder / "api" / f"{package}.rst", names_page(package, listed[package]))
    _write(folder / "api" / "index.rst", api_index(listed))
    for name in ("CONVENTIONS", "CHANGELOG", "CONTRIBUTING"):
        text = (ROOT / f"{name}.md").read_text()
        _write(folder / f"{name.lower()}.md", text)


def _write(path: Path, text: str) -> None:
    """Write a file if its text is new, so that Sphinx reads only what changed."""
    if not path.exists() or path.read_text() != text:
        path.write_text(text)


def environment_page(name: str, environment: type, preset: str) -> str:
    """Return the Markdown page of an environment, made from its docstring."""
    title, _, rest = inspect.getdoc(environment).partition("\n\n")
    body, _, example = rest.partition("\nExamples\n--------\n")
    body = re.sub(r":\w+:`~?(?:[\w.]+\.)?(\w+)`", r"`\1`", body)
    body = re.sub(r"``", "`", body)
    body = re.sub(r"::$", ":", body, flags=re.MULTILINE)
    body = re.sub(r"(?<=## Arguments\n).*?(?=\n## |\Z)", _definitions, body, flags=re.S)
    return f"""# {name}

{title}

```{{image}} {name}.gif
:alt: An episode of {name} in the preset {preset}
:width: 480px
```

```python
import gymnasium
import slamgym

env = gymnasium.make("slamgym/{name}-v0", scenario="{preset}")
```

{body}

## Example

```pycon
{example.strip()}
```
"""


def _definitions(arguments: re.Match[str]) -> str:
    """Turn the arguments of a numpydoc docstring into a definition list."""
    lines = []
    for line in arguments.group().strip().splitlines():
        if line.startswith(" "):
            lines.append(line)
            continue
        name, _, kind = line.partition(" : ")
        lines += ["", f"`{name}`" + f" ({kind})" * bool(kind)]
    text = re.sub(r"\n    (\S)", r"\n: \1", "\n".join(lines))
    return re.sub(r"(\n: [^\n]*(?:\n: [^\n]*)*)", _one_definition, text) + "\n"


def _one_definition(lines: re.Match[str]) -> str:
    return "\n: " + lines.group().replace("\n: ", "\n").strip().replace("\n", "\n  ")


def public_names() -> dict[str, list[str]]:
    """Return the public names of each package; every object under one package only."""
    taken: set[int] = set()
    listed: dict[str, list[str]] = {}
    for package in PACKAGES:
        found = []
        for name in getattr(package, "__all__", ()):
            thing = getattr(package, name)
            if inspect.ismodule(thing) or id(thing) in taken:
                continue
            taken.add(id(thing))
            found.append(name)
        if found:
            listed[package.__name__] = found
    return listed


def names_page(package: str, names: list[str]) -> str:
    """Return the page of a package: its docstring and a table of its names."""
    rule = "=" * len(package)
    module = importlib.import_module(package)
    about = (inspect.getdoc(module) or "").split("\n\n")[0]
    environments = {cls.__name__: page for page, (cls, _) in ENVIRONMENTS.items()}
    constants = [name for name in names if not callable(getattr(module, name))]
    described = {*environments, *constants}
    parts = public_names_by_part(module, [n for n in names if n not in described])
    tables = "\n\n".join(_table(part, found) for part, found in sorted(parts.items()))
    data = "\n\n".join(_constant(package, name) for name in constants)
    pages = "\n".join(
        f"* :doc:`{name} <../{environments[name]}>`"
        for name in names
        if name in environments
    )
    return f"""{package}
{rule}

{about}

.. currentmodule:: {package}

{pages}

{tables}

{data}
"""


def public_names_by_part(module: ModuleType, names: list[str]) -> dict[str, list[str]]:
    """Return the names of a package by the module or folder that has them."""
    parts: dict[str, list[str]] = {}
    for name in names:
        home = getattr(module, name).__module__.removeprefix(f"{module.__name__}.")
        parts.setdefault(home.split(".")[0], []).append(name)
    return parts


def _table(part: str, names: list[str]) -> str:
    rows = "\n".join(f"   {name}" for name in names)
    return f"""{part}
{"-" * len(part)}

.. autosummary::
   :toctree: names
   :nosignatures:

{rows}"""


def _constant(package: str, name: str) -> str:
    """Describe a constant: its value, and the text below it in its module."""
    thing = getattr(importlib.import_module(package), name)
    texts = [
        text
        for module in list(sys.modules.values())
        if module.__name__.startswith("slamgym.") and vars(module).get(name) is thing
        for text in ModuleAnalyzer.for_module(module.__name__)
        .find_attr_docs()
        .get(("", name), ())
    ]
    about = " ".join(texts).strip()
    return f".. py:data:: {name}\n   :value: {thing!r}\n\n   {about}"


def api_index(listed: dict[str, list[str]]) -> str:
    """Return the page that lists the packages, and the names at the top."""
    pages = {
        id(getattr(importlib.import_module(package), name)): f"{package}.{name}"
        for package, names in listed.items()
        for name in names
    }
    top = "\n".join(
        f"* {_link(name, pages[id(thing)])}: {_first_sentence(thing)}"
        for name in slamgym.__all__
        if not inspect.ismodule(thing := getattr(slamgym, name))
    )
    rows = "\n".join(f"   {package} <{package}>" for package in listed)
    return f"""Public names
============

The names used most can be imported from ``slamgym`` itself:

{top}

.. toctree::
   :maxdepth: 1

{rows}
"""


def _first_sentence(thing: object) -> str:
    text = (inspect.getdoc(thing) or "").split("\n\n")[0].replace("\n", " ")
    return re.sub(r"(?::\w+:)?`+~?([^`]+)`+", r"``\1``", text)


def examples_page() -> str:
    """Return the page that shows the programs of ``examples``, folded."""
    parts = [
        "# Examples",
        "You can run each program without changes in a clone of the repository.",
    ]
    for path in sorted((ROOT / "examples").glob("[0-9]*")):
        language = {".py": "python", ".c": "c"}[path.suffix]
        code = path.read_text()
        about = re.search(r'"""(.+?)(?:\n\n|""")|/\* (.+?)(?:\n \*\n|\*/)', code, re.S)
        said = " ".join((about.group(1) or about.group(2)).split()) if about else ""
        title = f"{path.name}: {said}".replace("`", "")
        parts.append(f"````{{dropdown}} {title}\n```{language}\n{code}```\n````")
    return "\n\n".join(parts) + "\n"


def _link(name: str, page: str) -> str:
    environments = {cls.__name__: page for page, (cls, _) in ENVIRONMENTS.items()}
    if name in environments:
        return f":doc:`slamgym.{name} <../{environments[name]}>`"
    return f":py:obj:`slamgym.{name} <{page}>`"


_OUTSIDE = re.compile(r"\[([^\]]+)\]\((?:\.\./)+([^)#\s]*)(#[^)]*)?\)")


def point_into_the_site(app: Sphinx, document: str, source: list[str]) -> None:
    """Turn links to files beside ``docs`` into links to pages of the site, or text."""
    depth = document.count("/")
    pages = {
        f"{name}.md": "../" * depth + f"generated/{name.lower()}.md"
        for name in ("CONVENTIONS", "CHANGELOG", "CONTRIBUTING")
    }

    def replacement(match: re.Match[str]) -> str:
        text, target, anchor = match.group(1), match.group(2), match.group(3) or ""
        if target in pages:
            return f"[{text}]({pages[target]}{anchor})"
        return text

    source[0] = _OUTSIDE.sub(replacement, source[0])
    if document.startswith("generated/"):
        source[0] = _root_links(source[0], depth)


def _root_links(text: str, depth: int) -> str:
    """Mend links of a page that stands at the root of the repository."""
    up = "../" * depth
    text = re.sub(r"\]\(docs/", f"]({up}", text)
    names = "|".join(("CONVENTIONS", "CHANGELOG", "CONTRIBUTING"))
    text = re.sub(
        rf"\]\(({names})\.md", lambda found: f"]({found.group(1).lower()}.md", text
    )
    return re.sub(r"\[([^\]]+)\]\((?!https?:|\.\./|#|[a-z]+\.md)[^)]*\)", r"\1", text)
