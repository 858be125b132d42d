# ---
# jupyter:
#   jupytext:
#     formats: py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Your own network, loss and grid
#
# A network and a loss of your own take the places of the paper's, are trained, compared with the Kalman filters over
# the same outages, and end up in MLflow. Nothing of the package is changed. Sizes are tiny, so that the page runs in
# seconds: four drives of 40 s and four epochs make a filter that is far worse than any Kalman filter. For real sizes
# leave the small numbers out, or start from `+profile=quick`.
#
# `%run -m dlkf.train …` in a notebook is `python -m dlkf.train …` in a shell.

# %% [markdown]
# ## Data
#
# Nine short drives with IMU, GNSS and truth. Your own logs become such a dataset with `dlkf.ingest`.

# %%
# %run -m dlkf.simulate dataset=per_drive dataset.hours=0.1 dataset.drive_minutes=0.67 dataset.imu_rate_hz=50 seed=3 out=data/idea

# %% [markdown]
# ## A network
#
# It takes the window of IMU samples `(B, 15, M)`, the components `(B, 30)` (innovation, state change, …) and its own
# memory, and gives a feature vector of length `width`. The heads that make gain and IMU error of it are the package's.

# %%
# %%writefile gru.py
import torch
from torch import nn


class Gru(nn.Module):
    """Means over the window and the components through one GRU cell."""

    def __init__(self, width=24, flags=0):
        super().__init__()
        self.width = width
        self.cell = nn.GRUCell(15 + 30 + flags, width)

    def start(self, batch_size, like):
        return (like.new_zeros(1, batch_size, self.width),)

    def forward(self, window, components, memory):
        h = self.cell(torch.cat((window.mean(-1), components), -1), memory[0][0])
        return h, (h.unsqueeze(0),)


# %% [markdown]
# ## A loss
#
# Named terms of solution and batch; the training weighs position, velocity and attitude adaptively.


# %%
# %%writefile logarithmic.py
class Logarithmic:
    """log(1 + error/scale): outages that are hard anyway count less."""

    def __init__(self, position=1.0, velocity=0.1, attitude=0.02):
        self.scale = {"position": position, "velocity": velocity, "attitude": attitude}

    def __call__(self, solution, batch):
        error = solution.prior.error_to(batch.truth).abs()
        known = (batch.truth_valid & batch.attitude_valid & batch.present)[..., None]
        terms = (error[..., k : k + 3] for k in (0, 3, 6))
        return {
            name: ((term.nan_to_num() / s).log1p() * known).sum() / known.sum().clamp_min(1)
            for (name, s), term in zip(self.scale.items(), terms)
        }


# %% [markdown]
# ## An experiment
#
# A file that opens with its claim and sets what differs. Here it also makes everything small.

# %%
from pathlib import Path

Path("mine/experiment").mkdir(parents=True, exist_ok=True)
_ = Path("mine/experiment/idea.yaml").write_text("""\
# @package _global_
# Claim: one GRU cell and a logarithmic loss hold position in outages as well as the CNN-LSTM.
name: idea
data: {datasets: [data/idea], batch_size: 4, fractions: [0.5, 0.2, 0.3], length_s: 20, eval_length_s: 30,
       eval_outage: {first_s: 10, duration_s: 10}}
model: {network: {_target_: gru.Gru, width: 24}}
trainer: {max_epochs: 4, validate_every: 1, best_from_epoch: 1}
callbacks: {curriculum: {warm_s: 15, full_s: 20, warm_until: 1, full_from: 2},
            outage: {duration_s: [4, 10], before_s: 5}}
baselines: {models: [mbkf15, mbkf21_nhc], tune: false, segments: 4}
scoring: {outage: {first_s: 10, duration_s: 10}, after_s: [], hour: null, injected_bias: null}
""")

# %% [markdown]
# ## Train, on a grid
#
# `dlkf.train --config-dir mine +experiment=idea` alone is one training. `-m` and several values of a key, or of several, make a grid: one
# run in MLflow for each point, one parent that compares them; the point that validated best is the champion. Every run ends
# with what was trained beside the Kalman filters, one table and the verdict. The report has the rest.

# %%
# %run -m dlkf.train +experiment=idea +loss._target_=logarithmic.Logarithmic optimizer.lr=1e-3,1e-2 tracking.alias=champion --config-dir mine -m

# %% [markdown]
# ## What MLflow has
#
# `dlkf ui` opens its pages. The same in Python:

# %%
import matplotlib.pyplot as plt
import mlflow

mlflow.set_tracking_uri("sqlite:///mlflow.db")
runs = mlflow.search_runs(experiment_names=["idea"]).sort_values("start_time")
runs = runs[runs["metrics.val/outage_end_m"].notna()]
columns = {"tags.mlflow.runName": "run", "metrics.val/outage_end_m": "val/outage_end_m"}
print(runs[[*columns]].rename(columns=columns).to_string(index=False))

client = mlflow.MlflowClient()
fig, ax = plt.subplots(figsize=(7, 3))
for run_id, name in zip(runs["run_id"], runs["tags.mlflow.runName"]):
    history = client.get_metric_history(run_id, "val/outage_end_m")
    ax.plot([m.step for m in history], [m.value for m in history], "o-", label=name)
ax.set(xlabel="step", ylabel="validation: end of outages [m]")
ax.legend(fontsize=8)
plt.show()

# %% [markdown]
# ## Use it
#
# The champion by its name, on frames of another drive, beside a Kalman filter:

# %%
import dlkf

drive = dlkf.simulate("per_drive", minutes=1.5, seed=9)[0]
report = dlkf.evaluate(drive.imu, drive.gnss, drive.reference, models=["mbkf15", "models:/idea@champion"], outage_s=10)
print(report.table.round(2).to_string())
