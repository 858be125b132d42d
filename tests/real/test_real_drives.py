"""Real drives: load, navigate without a reference, evaluate. Skipped where the data are not at hand."""

import json
import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from dlkf.data.alignment import align_boundaries
from dlkf.data.store import load_dataset
from dlkf.evaluation.results import Results
from dlkf.navigation.attitude import vector_from_rotation
from tests.cars import REAL

pytestmark = pytest.mark.skipif(not REAL.is_dir(), reason="no real drives beside the checkout")


def drives(name, **options):
    return load_dataset(REAL / name, dtype=torch.float64, **options)


def test_all_real_datasets_load_with_what_they_do_not_know():
    kitti, rtkx, comma = (drives(name) for name in ("kitti", "rtkx", "comma2k19"))
    assert (len(kitti), len(rtkx), len(comma)) == (43, 1, 1)
    for drive in (*kitti, *rtkx, *comma):
        assert drive.imu.isfinite().all() and drive.gnss_valid.any(-1).sum() > 0.9 * drive.epochs
        assert drive.gnss_std[drive.gnss_valid.any(-1)].isfinite().all()  # comma2k19 gives none: by quality
    assert not rtkx[0].ref_C_eb.isfinite().any() and rtkx[0].ref_valid.sum() == 333  # no roll and pitch; 2 s of float
    assert not comma[0].gnss_valid[:, 5].any()  # no vel_d


def test_alignment_agrees_with_a_tactical_reference():
    """Levelling to 0.3° RMS; course is heading to 1.5° RMS above 5 m/s (sideslip, GNSS noise 0.05 m/s)."""
    squares = []
    for drive in drives("kitti", drives=["kitti-2011-09-30-0018-s0", "kitti-2011-10-03-0042-s0"]):
        aligned = align_boundaries(drive)
        fast = aligned.ok & drive.ref_valid & (aligned.v_e.norm(dim=-1) > 5)
        squares.append(vector_from_rotation(aligned.C_eb[fast].mT @ drive.ref_C_eb[fast]).square())
    roll, pitch, yaw = np.degrees(torch.cat(squares).mean(0).sqrt().numpy())
    assert max(roll, pitch) < 0.35 and yaw < 1.5


@pytest.mark.parametrize(
    ("name", "chosen"), [("rtkx", []), ("kitti", ["drives=[kitti-2011-10-03-0042-s0]"]), ("comma2k19", [])]
)
def test_navigate_needs_no_reference(call, tmp_path, name, chosen):
    shutil.copytree(REAL / name, tmp_path / name, ignore=shutil.ignore_patterns("reference"))
    done = call("navigate", "model=mbkf15", f"dataset={name}", "out=solved", *chosen)
    assert done.code == 0, done.err
    (solution,) = (tmp_path / "solved").glob("drive=*/solution.parquet")
    table = pq.read_table(solution).to_pandas()
    assert len(table) > 50 and np.isfinite(table.drop(columns=["gnss_used", "geometry"]).to_numpy(float)).all()
    assert table.gnss_used.mean() > 0.9


@pytest.mark.parametrize(
    ("name", "options", "outages", "low", "high"),
    [  # measured 51.6, 11.5 and 2.57 m RMS after 30 s; about half and 1.4 times that are the bounds
        ("rtkx", ["imu=roof_mems", "tuning.velocity_std=2", "outage.first_s=25"], 9, 25, 72),
        ("comma2k19", ["outage.first_s=15", "outage.offsets_s=[0,5,10]"], 3, 5, 16),
        ("kitti", ["imu=tactical_oxts", "outage.first_s=20", "drives=[kitti-2011-10-03-0042-s0]"], 3, 1.2, 3.6),
    ],
)
def test_outages_of_30_s_stay_where_they_were_measured(call, tmp_path, name, options, outages, low, high):
    done = call(
        "evaluate", "model=mbkf15", f"dataset={REAL / name}", "mode=drives", "out=report",
        "outage.duration_s=30", "injected_bias=null", "tracking.log=false", *options,
    )  # fmt: skip
    assert done.code == 0, done.err
    (content,) = json.loads((tmp_path / "report" / "metrics.json").read_text())["results"]
    result, end = Results.of(content), ("mbkf15", "outages", "end", "horizontal")
    assert result.count["outages"] == outages
    assert result.value(*end, "nonfinite") == 0 and low < result.value(*end) < high
