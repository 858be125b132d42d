"""Datasets and results at URLs: the same as on the disk, whole or none, and one line where a store cannot be had."""

from __future__ import annotations

import os
import signal

import fsspec
import pandas as pd
import pytest

from dlkf.base.errors import InputError
from dlkf.base.files import (
    absolute_place,
    folder_name,
    local_copy,
    replace_file,
    replace_folder,
    require_empty,
    resolve_place,
    write_into,
)
from dlkf.data.schema import remove_drive
from dlkf.data.store import load_dataset
from dlkf.data.tables import dataset_digest, read_drives
from dlkf.data.validate import validate_dataset

ENDPOINT = "AWS_ENDPOINT_URL"
KEYS = {"AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret", "AWS_DEFAULT_REGION": "us-east-1"}


@pytest.fixture(scope="module")
def server():
    """An S3 server of this machine."""
    pytest.importorskip("s3fs")
    moto = pytest.importorskip("moto.server")
    given = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    given.start()
    host, port = given.get_host_and_port()
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {**KEYS, ENDPOINT: f"http://{host}:{port}"}.items():
            patch.setenv(name, value)
        fsspec.filesystem("s3", skip_instance_cache=True).mkdir("drives")
        yield
    given.stop()


@pytest.fixture
def bucket(server) -> str:
    """The URL of an empty folder."""
    fs = resolve_place("s3://drives").fs
    if keys := fs.find("drives"):
        fs.rm(keys)
    return "s3://drives/new"


@pytest.fixture(params=["memory", "s3"])
def store(request) -> str:
    """The same in every kind of store."""
    if request.param == "s3":
        return request.getfixturevalue("bucket")
    fsspec.filesystem("memory").store.clear()
    return "memory://drives/new"


def copied(town, url: str) -> str:
    """A dataset of the disk, with the package's own means."""
    with replace_folder(url) as folder:
        for file in town.rglob("*.parquet"):
            with replace_file(folder / file.relative_to(town).as_posix()) as beside:
                beside.write_bytes(file.read_bytes())
    return url


def files(url: str) -> list[str]:
    place = resolve_place(url)
    return sorted(p.relative_to(place).as_posix() for p in place.rglob("*") if p.is_file())


def test_a_dataset_of_a_store(town, store):
    there = copied(town, store)
    assert [row.name for row in validate_dataset(there)] == [row.name for row in read_drives(town)]
    assert dataset_digest(there) == dataset_digest(town)
    here, far = (load_dataset(folder, rate_hz=50, drives=["car-1"])[0] for folder in (town, there))
    assert (here.imu == far.imu).all() and far.dataset == folder_name(store) == "new"


def test_a_drive_is_removed_from_a_store(town, store):
    there = copied(town, store)
    before = files(there)
    remove_drive(there, "car-1")
    assert files(there) == [x for x in before if "drive=car-1/" not in x] != before


def test_whole_or_none(town, store):
    copied(town, store)
    before = files(store)
    with (
        pytest.raises(ZeroDivisionError),
        replace_folder(store) as folder,
        replace_file(folder / "drives.parquet") as file,
    ):
        file.write_bytes(b"half")
        raise ZeroDivisionError
    with pytest.raises(ZeroDivisionError), write_into(store) as folder:
        (folder / "drives.parquet").write_bytes(b"half")
        raise ZeroDivisionError
    assert files(store) == before and [p.name for p in resolve_place(store).parent.iterdir()] == ["new"]
    with replace_folder(store) as folder, replace_file(folder / "other" / "x") as file:
        file.write_bytes(b"all")
    assert files(store) == ["other/x"]
    with write_into(store) as folder:
        (folder / "report.html").write_text("page")
    assert files(store) == ["other/x", "report.html"]
    with local_copy(store) as folder:
        assert (folder / "other" / "x").read_bytes() == b"all" and (folder / "report.html").read_text() == "page"
    with pytest.raises(InputError, match="exists already"):
        require_empty(store, overwrite=False)


def test_commands(town, bucket, call):
    """simulate, ingest and navigate into a store and out of it."""
    small = ("dataset.hours=0.01", "dataset.imu_rate_hz=50", "dataset=one_imu")
    for out in ("here", f"{bucket}/town"):
        done = call("simulate", *small, f"out={out}")
        assert done.code == 0, done.err
        done = call("navigate", f"dataset={out}", "model=mbkf15", "export=csv", f"out={out}-solved")
        assert done.code == 0, done.err
    assert dataset_digest("here") == dataset_digest(f"{bucket}/town")
    assert "drive=one_imu-1-00000/solution.csv" in files(f"{bucket}/town-solved")
    tables = []
    for folder in ("here-solved", f"{bucket}/town-solved"):
        (path,) = resolve_place(folder).rglob("solution.parquet")
        with path.open("rb") as file:
            tables.append(pd.read_parquet(file))
    pd.testing.assert_frame_equal(*tables)
    done = call("simulate", *small, f"out={bucket}/town")
    assert done.code == 2 and "exists already" in done.err
    done = call("navigate", f"dataset={bucket}/none", "model=mbkf15", "out=x")
    assert done.code == 2 and "no such folder" in done.err and len(done.err.splitlines()) == 1


@pytest.mark.commands
def test_an_evaluation_in_a_store(town, bucket, call, uri):
    """Which MLflow logs, too."""
    given = (f"dataset={copied(town, bucket)}", f"out={bucket}/eval")
    done = call("evaluate", "model=ins", "length_s=30", "~outage", *given)
    assert done.code == 0, done.err
    assert "report.html" in files(f"{bucket}/eval")


def test_a_bucket_is_no_dataset(town, bucket):
    """Nor are all buckets together: what replaced them would take everything away that lies there."""
    copied(town, bucket)
    before = files(bucket)
    for whole in ("s3://", "s3://drives", "s3://drives/"):
        said = f"^out={whole} is a whole bucket.*give a folder in it$"
        with pytest.raises(InputError, match=said), replace_folder(whole):
            pytest.fail("nothing is written there")
    assert files(bucket) == before


def test_one_line_where_a_store_cannot_be_had(server, monkeypatch):
    for wrong in (lambda: require_empty("s3://nobody/x", overwrite=False), lambda: read_drives("s3://nobody/x")):
        with pytest.raises(InputError, match=r"^s3://nobody/x: there is no bucket nobody; make it first$"):
            wrong()
    with pytest.raises(InputError, match=r"^quill://x: .*known are paths, s3:// and gs://"):
        resolve_place("quill://x")
    for name in KEYS:
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    monkeypatch.setenv("HOME", "/nowhere")
    fsspec.filesystem("s3").clear_instance_cache()
    with pytest.raises(InputError, match=r"^s3://drives/x: store error: Unable to locate credentials"):
        require_empty("s3://drives/x", overwrite=False)
    fsspec.filesystem("s3").clear_instance_cache()


def test_places_of_this_machine_stay_paths(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert resolve_place("a/b") == (tmp_path / "a/b").relative_to(tmp_path) and absolute_place("a") == str(
        tmp_path / "a"
    )
    assert absolute_place("s3://a/b") == "s3://a/b"


def test_a_killed_writer_leaves_nothing_in_a_folder(tmp_path):
    """As a worker that dies while it writes, whose folder goes on."""
    with replace_folder(tmp_path / "new") as folder:
        if (child := os.fork()) == 0:
            with replace_file(folder / "half") as beside:
                beside.write_text("half")
                os.kill(os.getpid(), signal.SIGKILL)
        os.waitpid(child, 0)
        assert len(list(folder.iterdir())) == 1
    assert list((tmp_path / "new").iterdir()) == []
