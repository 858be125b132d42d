"""Every command line and every setting that the pages name exists: commands compose, scripts know their options."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dlkf.base.config import config_dir
from dlkf.command import GROUPS
from dlkf.command.arguments import quote_argument
from tests.docs.pages import PAGES, ROOT, blocks, commands

CHAIN = ROOT / "pipelines" / "trainings.py"
PRIMARIES = sorted(p.stem for p in config_dir().glob("*.yaml") if p.stem != "hydra_output")


def spelt_out(words: list[str]) -> list[str]:
    """``dlkf evaluate`` and ``dlkf.evaluate`` as ``python -m dlkf.evaluate``."""
    if words[:1] == ["dlkf"] and words[1:] and not words[1].startswith("-"):
        return ["python", "-m", f"dlkf.{words[1]}", *words[2:]]
    return ["python", "-m", *words] if words and words[0].startswith("dlkf.") else words


SHELL = [
    (page, tuple(words))
    for page in PAGES
    for text in (
        *(b.text for b in blocks(page) if not b.language and not b.file),
        *re.findall(r"`((?:python|make|dlkf|dlkf\.\w+) [^`\n]+)`", page.read_text()),
    )
    for words in map(spelt_out, commands(text))
    if words[0] in ("python", "make") and not re.search(r"dlkf\.[…<]|pipelines/…", " ".join(words))
]


def commented(preset: Path) -> str:
    """The commands among a preset's comments, without what stands beside them."""
    comments = "\n".join(m[1] for m in re.finditer(r"^#(.*)$", preset.read_text(), re.M))
    lines = re.findall(r"^   (python (?:[^\\\n]|\\\n)*)", comments, re.M)
    return "\n".join(re.sub(r"(?<=[^\n ]) {4,}[^ ].*", "", line) for line in lines)


PRESETS = [
    (preset, tuple(words))
    for preset in sorted(config_dir().rglob("*.yaml"))
    for words in map(spelt_out, commands(commented(preset)))
]
# presets that the pages tell a reader to write into mine/
MINE = {
    "imu": ["my_imu", "ours", "shed"],
    "tuning": ["ours", "town"],
    "reader": ["xsens", "shed"],
    "experiment": ["fresh_bias", "idea"],
    "simulated": ["van"],
}
# conf of one command has only what is chosen; these choices bring in the keys that others lack
VARIANTS = {
    "simulate": [
        ["simulated@dataset=city", "receiver=rtk"],
        ["simulated@dataset=paper_clean", "receiver=undisturbed"],
        ["simulated@dataset=fleet"],
        ["simulated@dataset=wide"],
    ],
    "train": [["+experiment=outage", "filter@model=dlkf_kalman"]],
}
SETTING = re.compile(r"^([a-z_]+(?:\.[a-z_]+)+)(?:=.*)?$")


@pytest.fixture(scope="module")
def mine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A reader's own presets: as the pages print them where they do, else like one of ours."""
    folder = tmp_path_factory.mktemp("mine")
    like = {"imu": "consumer", "tuning": "untuned", "reader": "csv", "experiment": "outage", "simulated": "lifelike"}
    for group, names in MINE.items():
        (folder / group).mkdir()
        for name in names:
            (folder / group / f"{name}.yaml").write_text((config_dir() / group / f"{like[group]}.yaml").read_text())
    for page in PAGES:
        for block in blocks(page):
            if block.file and block.file.startswith("mine/"):
                (folder / block.file.removeprefix("mine/")).write_text(block.text)
    return folder


@cache
def composed(primary: str, overrides: tuple[str, ...]) -> DictConfig:
    """A command's configuration, as the command itself would compose it."""
    with initialize_config_dir(config_dir=str(config_dir()), version_base="1.3"):
        return compose(primary, list(overrides))


def compose_line(primary: str, overrides: list[str]) -> None:
    """Fails where a command line does not compose. Presets are composed once for all lines that choose the same; a
    value's key must be in what they give, and its words in Hydra's grammar."""
    presets, values = [], []
    for override in OverridesParser.create().parse_overrides(overrides):
        key = override.key_or_group
        preset = "@" in override.input_line or key in ("experiment", "profile") or (config_dir() / key).is_dir()
        if preset or override.is_delete() or key.startswith("hydra"):
            presets.append(override.input_line)
        elif not override.is_add() and not override.is_force_add():
            values.append(key)
    config = composed(primary, tuple(presets))
    for key in values:
        parent, _, name = key.rpartition(".")
        node = OmegaConf.select(config, parent) if parent else config
        keys_there = list(node) if OmegaConf.is_dict(node) else [name]  # a value that is missing has a key
        assert name in keys_there, f"no key {key}"


def as_hydra_takes_it(command: str, word: str) -> str:
    key, equals, value = word.partition("=")
    groups = GROUPS.get(command, {})
    if command == "ingest" and key.startswith("reader."):
        return quote_argument(f"++{word}")
    return quote_argument(f"{groups[key]}@{key}={value}" if equals and key in groups else word)


def test_blocks_do_not_write_into_each_other_s_folders() -> None:
    """A reader follows the front page, then others: where two lines differ, so do their folders."""
    lines: dict[str, dict[tuple[str, ...], str]] = {}
    for page in PAGES:
        if not {"results", "tutorials", "RESULTS.md"}.intersection(page.parts):
            for block in (b for b in blocks(page) if not b.language and not b.file):
                for words in map(spelt_out, commands(block.text)):
                    for out in (word for word in words if word.startswith("out=") and word != "out=mine"):
                        lines.setdefault(out, {})[tuple(words)] = page.name
    assert len(lines) > 30
    assert not [(out, list(where.values())) for out, where in lines.items() if len(where) > 1]


@pytest.mark.whole
@pytest.mark.parametrize("lines", [SHELL, PRESETS], ids=["pages", "presets"])
def test_every_command_line_exists(lines: list[tuple[Path, tuple[str, ...]]], mine: Path) -> None:
    assert len(lines) > 50
    wrong = []
    for words in {words: None for _, words in lines}:
        try:
            check(words, mine)
        except (AssertionError, HydraException, OmegaConfBaseException, ValueError) as error:
            places = sorted({str(page.relative_to(ROOT)) for page, line in lines if line == words})
            wrong.append(f"{', '.join(places)}: {' '.join(words)}: {error}")
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(
    "line",
    [
        "make tea",
        "python -m dlkf.brew dataset=data/town",
        "python -m dlkf.evaluate modle=mbkf15",
        "python -m dlkf.evaluate imu=best",
        "python -m dlkf.train -m seed=0,1 optimizer.speed=1,2",
        "python -m pytest tests/nowhere",
        "python -m pipelines.nowhere",
        "python -m pipelines.studies.benchmark --colour=red",
    ],
)
def test_a_wrong_line_would_be_found(line: str, mine: Path) -> None:
    with pytest.raises((AssertionError, HydraException, OmegaConfBaseException)):
        check(tuple(line.split()), mine)


def check(words: tuple[str, ...], mine: Path) -> None:
    """Fails unless a command line composes, or calls a script with options that stand in it."""
    given = [w for w in words if w != "…" and "<" not in w]
    if given[0] == "make":
        targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.M)
        unknown = {w for w in given[1:] if "=" not in w} - set(targets)
        assert not unknown, f"no target {unknown}"
    elif given[1] == "-m" and given[2].startswith("dlkf"):
        command = given[2].removeprefix("dlkf.")
        rest = given[3:]
        if command not in PRIMARIES:  # not Hydra's
            assert (ROOT / "src" / "dlkf" / f"{command}.py").is_file(), "no such command"
            return
        if "--config-dir" in rest:
            k = rest.index("--config-dir")
            rest[k : k + 2] = [f"hydra.searchpath=[file://{mine}]"]
        sweep = "-m" in rest
        overrides = [as_hydra_takes_it(command, w) for w in rest if "=" in w]  # compare takes bare folders
        if sweep:  # a point of it
            overrides = [re.sub(r"=(\[[^\]]*\]|[^\[,]+),.*$", r"=\1", o) for o in overrides]
        compose_line(command, overrides)
    elif given[1:3] == ["-m", "pytest"]:
        assert all((ROOT / w).exists() for w in given[3:]), "no such tests"
    else:
        script = given[2].replace(".", "/") + ".py" if given[1] == "-m" else given[1]
        assert (ROOT / script).is_file(), script
        text = (ROOT / script).read_text()
        if "from trainings import" in text:
            text += CHAIN.read_text()
        unknown = [w for w in given[2:] if w.startswith("--") and f'"{w.partition("=")[0]}"' not in text]
        assert not unknown, f"{script} knows no {unknown}"


@cache
def keys() -> frozenset[str]:
    """Every setting of every command, dotted, and every preset's."""
    found: set[str] = set()
    for primary in PRIMARIES:
        for variant in VARIANTS.get(primary, [[]]):
            found |= dotted(OmegaConf.to_container(composed(primary, tuple(variant)), resolve=False))
    return frozenset(found)


def known(name: str) -> bool:
    """Whether a dotted name is a setting, or ends one."""
    return any(key == name or key.endswith(f".{name}") for key in keys())


def dotted(values: Any, prefix: str = "") -> set[str]:
    if not isinstance(values, dict):
        return set()
    return {f"{prefix}{key}" for key in values}.union(*(dotted(v, f"{prefix}{k}.") for k, v in values.items()))


def test_settings_named_in_the_text_exist() -> None:
    groups = {part for key in keys() for part in key.split(".")[:-1]}
    lost = []
    for page in PAGES:
        text = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.M | re.S)
        named = {m[1] for code in re.findall(r"`([^`\n]+)`", text) for w in code.split() if (m := SETTING.match(w))}
        unknown = {n for n in named if not n.endswith((".c", ".h")) and n.partition(".")[0] in groups and not known(n)}
        unknown |= set(re.findall(r"`([a-z_]+)\.\*`", text)) - groups
        lost += [f"{page.relative_to(ROOT)}: {name}" for name in sorted(unknown)]
    assert not lost, "\n".join(lost)
