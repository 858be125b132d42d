"""A training step of this code beside that of another checkout: ``python -m pipelines.studies.training_turns FOLDER``.

Batches of 50 pieces of a minute with decimation, outages, gradient, clipping and AdamW, the same for all, in turns in
two processes of one thread each: the literal network of the other checkout, ours, and ``plus``. Told are the least
processor time of a step, and of sums over all rounds and of pairs of neighbours the ratio to the other checkout's.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from dlkf.command.simulated import composed_recipe
from dlkf.simulation.dataset import simulate

# runs on either code, so it says no more than what both have
WORKER = """
import json, sys, time
import torch
from dlkf.data.datamodule import DriveDataModule
from dlkf.filters.integration import integrate
from dlkf.filters.learned import LearnedConfig, LearnedFilter
try:
    from dlkf.training.callbacks.masking import GnssDecimation, OutageInjection
except ImportError:
    from dlkf.training.callbacks.batches import GnssDecimation, OutageInjection
from dlkf.training.loss import TERMS, LossConfig, pva_losses, weighted

torch.set_num_threads(1)
data = DriveDataModule([sys.argv[1]], fractions=(1.0, 0.0, 0.0), batch_size=50)
data.setup()
models = {}
for line in sys.stdin:
    name, k = line.split()
    if name not in models:
        torch.manual_seed(0)
        if name == "plus":
            from dlkf.filters.plus import PlusConfig, PlusFilter
            model = PlusFilter(PlusConfig()).train()
        else:
            model = LearnedFilter(LearnedConfig()).train()
        models[name] = model, torch.optim.AdamW(model.parameters(), lr=1e-4)
    model, optimizer = models[name]
    torch.manual_seed(int(k))
    began = time.process_time()
    batch = data.train_batch(1, int(k) % (len(data.train_pieces(1)) - 1))  # the last is a smaller one
    generator = torch.Generator().manual_seed(int(k))
    for transform in (GnssDecimation(), OutageInjection(start_epoch=0)):
        batch = transform.transform(batch, 99, generator)
    loss = weighted(pva_losses(integrate(batch, model), batch, LossConfig()), dict.fromkeys(TERMS, 1.0))
    optimizer.zero_grad()
    loss.backward()
    torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
    optimizer.step()
    print(json.dumps([time.process_time() - began, loss.item()]), flush=True)
"""


def worker(root: Path, drives: Path) -> subprocess.Popen[str]:
    """A process that makes a step of the named model of the code at ``root`` with each line that it is given."""
    environment = os.environ | {"PYTHONPATH": str(root / "src"), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-W", "ignore", "-c", WORKER, str(drives)]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)


def step(process: subprocess.Popen[str], name: str, k: int) -> tuple[float, float]:
    """Processor time of a step [s], and its loss."""
    assert process.stdin is not None and process.stdout is not None
    process.stdin.write(f"{name} {k}\n")
    process.stdin.flush()
    seconds, loss = json.loads(process.stdout.readline())
    return seconds, loss


def main() -> None:
    """Simulate, take turns, print."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("checkout", type=Path, help="a checkout of another commit")
    arguments.add_argument("--rounds", type=int, default=18)
    arguments.add_argument("--hours", type=float, default=8.0)
    o = arguments.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        drives = Path(folder) / "drives"
        simulate(composed_recipe("simulated@dataset=one_imu", f"dataset.hours={o.hours}"), drives)
        other, ours = worker(o.checkout.resolve(), drives), worker(Path(__file__).parents[2], drives)
        turns = {"literal, other": (other, "literal"), "literal": (ours, "literal"), "plus": (ours, "plus")}
        for who, (process, name) in turns.items():
            print(f"{who}: first loss {step(process, name, 0)[1]:.7g}")
        seconds: dict[str, list[float]] = {who: [] for who in turns}
        for k in range(1, o.rounds + 1):
            for who, (process, name) in turns.items():
                seconds[who].append(step(process, name, k)[0])
        for process in (other, ours):
            process.kill()
    base = seconds["literal, other"]
    print("| | least step | of least steps | of sums | median of pairs |\n|:--|--:|--:|--:|--:|")
    for who, taken in seconds.items():
        pairs = statistics.median(x / y for x, y in zip(taken, base))
        ratios = (min(taken) / min(base), sum(taken) / sum(base), pairs)
        print(f"| {who} | {min(taken):.3f} s | {' | '.join(f'{ratio:.3f}' for ratio in ratios)} |", flush=True)


if __name__ == "__main__":
    main()
