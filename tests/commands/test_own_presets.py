"""A preset of one's own that is no preset is one line, whatever stands in it, and soon."""

from __future__ import annotations

import time

import pytest

BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi")
)
WRONG = {
    "an open bracket": ("a: [1", "mine.yaml is not readable YAML"),
    "a tab": ("defaults: [csv]\n\timu: {}", "mine.yaml is not readable YAML"),
    "a tag": ("_target_: !!python/object/apply:os.system [ls]", "mine.yaml is not readable YAML"),
    "a tag of one's own": ("imu: !thing 3", "mine.yaml is not readable YAML"),
    "a bomb": (BOMB, "aliases"),
    "itself": ("a: &a [*a]", "aliases"),
    "brackets": ("a: " + "[" * 5000, "nested too deeply"),
    "bytes": (b"\xff\xfe\x00a: 1".decode("latin-1"), "mine.yaml is not readable YAML"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_preset_that_is_none(case, call, tmp_path):
    content, said = WRONG[case]
    (tmp_path / "conf" / "reader").mkdir(parents=True)
    (tmp_path / "conf" / "reader" / "mine.yaml").write_text(content)
    began = time.monotonic()
    done = call("ingest", "--config-dir", "conf", "reader=mine", "source=logs", "out=made")
    assert done.code == 2 and done.err.count("\n") == 1 and "Traceback" not in done.err, done.err
    assert said in done.err and time.monotonic() - began < 20


def test_files_that_are_not_named_are_not_looked_at(call, tmp_path):
    """A broken file beside the preset is nobody's business."""
    (tmp_path / "conf" / "reader").mkdir(parents=True)
    (tmp_path / "conf" / "reader" / "other.yaml").write_text("a: [1")
    (tmp_path / "conf" / "reader" / "mine.yaml").write_text("defaults: [csv, _self_]\nseparator: ';'\n")
    done = call("ingest", "--config-dir", "conf", "reader=mine", "source=logs", "out=made")
    assert done.code == 2 and "source=logs: no such file" in done.err
