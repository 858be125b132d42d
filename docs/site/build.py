"""What MkDocs does beside turning Markdown into pages: front pages, API pages, equations as pictures.

README.md and RESULTS.md are pages too, and every room of the package has one made of its docstrings. Equations become
SVG while the pages are built, so reading them needs no script, no font and no network.
"""

from __future__ import annotations

import ast
import html
import re
from functools import cache
from pathlib import Path

import latex2mathml.converter
import ziamath
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
SRC = ROOT / "src" / "dlkf"
FRONT = {"index.md": ("README.md", ""), "results/index.md": ("RESULTS.md", "../")}
EQUATION = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.S)
NAMED = re.compile(r"`(dlkf(?:\.\w+){2,})`")
FENCE = re.compile(r"(^```.*?^```$)", re.M | re.S)
PUBLIC = ("navigation", "evaluation", "logs", "solution")  # modules of frames/ with the public functions
REMOTE_SHIM = "https://unpkg.com/iframe-worker/shim"
SIZE = 17  # px of an equation's letters
HAT, SMALL_HAT = "&#x0005E;", "&#x02C6;"


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """The API pages join the navigation."""
    assert config.nav is not None
    config.nav.append({"API": ["api/index.md", *(f"api/{room}.md" for room in rooms())]})
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """README, RESULTS and the API as pages."""
    for place, (source, up) in FRONT.items():
        text = (ROOT / source).read_text().replace("](docs/", f"]({up}").replace("](RESULTS.md", "](results/index.md")
        files.append(File.generated(config, place, content=text))
    files.append(File.generated(config, "api/index.md", content=overview()))
    for room, modules in rooms().items():
        page = f"# {room}\n\n{room_text(room)}\n\n" + "\n".join(f"::: {module}\n" for module in modules)
        files.append(File.generated(config, f"api/{room}.md", content=page))
    return files


def on_page_content(text: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Equations as SVG."""
    return EQUATION.sub(lambda found: drawn(html.unescape(found[2]).strip(), found[1] == "div"), text)


def on_page_markdown(text: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Names of functions and classes become links to their API."""
    text = text.replace("](../README.md", "](index.md").replace("](../RESULTS.md", "](results/index.md")
    parts = FENCE.split(text)  # every second one is a fenced block
    parts[::2] = [NAMED.sub(lambda found: linked(found[1]), part) for part in parts[::2]]
    return "".join(parts)


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """Search without network, also from pages opened as files."""
    return output.replace(REMOTE_SHIM, f"{'../' * page.url.count('/')}site/worker.js")


def on_post_template(output: str, template_name: str, config: MkDocsConfig) -> str:
    """The same for the page of a wrong address."""
    return output.replace(REMOTE_SHIM, "site/worker.js")


def linked(name: str) -> str:
    """A dotted name as a link to its API; packages and constants, which have no place of their own, as code."""
    has_none = SRC.joinpath(*name.split(".")[1:]).is_dir() or name.rpartition(".")[2].isupper()
    return f"`{name}`" if has_none else f"[`{shortened(name)}`][{name}]"


def shortened(name: str) -> str:
    """A dotted name without package and room."""
    return name.split(".", 2)[-1]


@cache
def drawn(latex: str, display: bool) -> str:
    """An equation as inline SVG on the text's baseline, read aloud as its LaTeX."""
    source = latex2mathml.converter.convert(latex, display="block" if display else "inline")
    math = ziamath.Math(source.replace(HAT, SMALL_HAT), size=SIZE)
    label = html.escape(latex, quote=True)
    style = "" if display else f' style="vertical-align:{math.getyofst():.2f}px"'
    svg = math.svg().replace("<svg ", f'<svg class="equation" role="img" aria-label="{label}"{style} ', 1)
    return f'<div class="equation">{svg}</div>' if display else svg


def rooms() -> dict[str, list[str]]:
    """Rooms of the package and the modules in them, the public functions first; what lies in no room is
    ``commands``."""
    found: dict[str, list[str]] = {}
    for file in sorted(SRC.rglob("*.py")):
        parts = file.relative_to(SRC).with_suffix("").parts
        if parts[-1] == "__init__":
            continue
        found.setdefault(parts[0] if len(parts) > 1 else "commands", []).append(".".join(("dlkf", *parts)))
    public = found.pop("frames")
    return {"frames": sorted(public, key=lambda module: module.rpartition(".")[2] not in PUBLIC), **found}


def room_text(room: str) -> str:
    """A room's own docstring, where it has one."""
    return docstring(SRC / room / "__init__.py") if room != "commands" else "The commands and what they share."


def overview() -> str:
    """The glossary of the package, and what is in which room."""
    public = "The public functions (`dlkf.navigate`, `evaluate`, `Stream`, `load`, `simulate`, `read_logs`) are"
    lines = [
        "# API",
        "",
        f"{public} in [frames](frames.md).",
        "",
        "```text",
        docstring(SRC / "__init__.py"),
        "```",
        "",
        "| room | files |",
        "|:--|:--|",
    ]
    for room, modules in rooms().items():
        files = " ".join(f"`{module.split('.', 2)[-1]}`" for module in modules)
        lines.append(f"| [{room}]({room}.md) | {files} |")
    return "\n".join(lines)


def docstring(file: Path) -> str:
    """Docstring of a module, without importing it."""
    return (ast.get_docstring(ast.parse(file.read_text())) or "") if file.is_file() else ""
