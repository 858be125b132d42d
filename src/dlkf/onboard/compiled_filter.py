"""A filter whose whole epoch is compiled code, in the place of the one that it was made of.

It is made once for a machine, a filter and a grid, and kept in the user's cache (``$XDG_CACHE_HOME/dlkf``). What a
model-based filter is given, IMU preset and factors, is in its memory and not in the code, so one library serves all
of them. It takes part where estimators do: in a batch, in a stream, in ``navigate``. It knows no gradients, no
covariances but their diagonals, and no device but the CPU.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

import dlkf
from dlkf.base.console import warn_once
from dlkf.base.errors import InputError
from dlkf.data.drive import Batch
from dlkf.filters.aids.attach import aid_columns, find_tables
from dlkf.filters.integration import BatchSolution, Correction, Estimator, Fix, Step, WholeLoop, integrate
from dlkf.filters.model_based import Mbkf
from dlkf.filters.smoother import Filter, SmoothedSolution
from dlkf.navigation.calibration import ImuError
from dlkf.navigation.compiled import without_loops
from dlkf.navigation.earth import TangentFrame
from dlkf.navigation.state import NavState
from dlkf.onboard.c_source import write_source
from dlkf.onboard.carried import Layout
from dlkf.onboard.functions import (
    Carried,
    Grid,
    count_output_numbers,
    cross_gap,
    make_layout,
    move_anchor,
    pack_fix,
    split_outputs,
)
from dlkf.onboard.library import FLAGS, Library, build, describe_machine, find_compiler, require_compiler
from dlkf.onboard.library_cache import find_cache, load_cached
from dlkf.running import bridging, reanchoring
from dlkf.running.bridging import Stretch, find_covariance
from dlkf.running.reanchoring import FrameChange, can_reanchor

MANY = 16  # drives from which on torch is faster than C where a network is large: measured with dlkf at 1 and 64
LARGE = 1_000_000  # weights: more than the cache of a core holds
_LOADED: dict[Path, tuple[Layout, Library]] = {}  # by folder, whose name is a digest of what they depend on


class Vector(NamedTuple):
    """The memory of a compiled filter."""

    numbers: Tensor  # (B, K)
    filter: CompiledFilter

    @property
    def P(self) -> Tensor | None:
        """Covariance of the error states, where the filter has one."""
        return find_covariance(self.filter.layout.unpack(self.numbers).memory)


class FixedVector(Vector):
    """The same of a filter whose memory cannot go to another tangent frame."""


class CompiledFilter(WholeLoop):
    """An :class:`dlkf.filters.integration.Estimator` that runs the loop itself; :func:`compile_filter` makes one."""

    def __init__(
        self, estimator: Estimator, grid: Grid, layout: Layout, library: Library, *, whole: bool = False
    ) -> None:
        self.estimator, self.grid, self.layout, self.library, self.whole = estimator, grid, layout, library, whole
        self._aids, self._columns = find_tables(estimator), aid_columns(estimator)
        self._vector = Vector if can_reanchor(layout.like.memory) else FixedVector

    def __reduce__(self) -> tuple[Callable, tuple]:
        return compile_filter, (self.estimator, 1 / self.grid.dt, self.grid.epoch_s, self.whole)

    def __getattr__(self, name: str) -> Any:
        """``config``, ``imu`` and the like are those of the filter that it was made of."""
        if name.startswith("__") or name in ("estimator", "states", "parameters"):
            raise AttributeError(name)
        return getattr(self.estimator, name)

    def begin(self, batch: Batch) -> tuple[Vector, Tensor | ImuError]:
        """That of the filter, packed. InputError for data on another grid."""
        if batch.size[2] != self.grid.samples or abs(batch.dt - self.grid.dt) > 1e-9 * self.grid.dt:
            raise InputError(
                f"this filter was compiled for {self.grid.samples} samples an epoch at {1 / self.grid.dt:g} Hz, the "
                f"data come with {batch.size[2]} at {1 / batch.dt:g} Hz"
            )
        batch = batch.in_precision(torch.float64)
        memory, error = self.estimator.begin(batch)
        x = Carried(memory, batch.start, ImuError.of(error), batch.frame, batch.lever_arm_b)
        return self._vector(self.layout.pack(x).contiguous(), self), error

    def step(self, memory: Any, epoch: Any) -> Any:
        """Not of an epoch's end alone: :meth:`advance`."""
        raise NotImplementedError

    def advance(self, memory: Vector, imu: Tensor, fix: Fix, frame: TangentFrame) -> tuple[Any, Step]:
        """One epoch of one drive."""
        vector, outputs = self.library.turn(memory.numbers, imu.contiguous(), pack_fix(fix, self._aids))
        x = split_outputs(outputs)
        bias, *others = (self.layout.field(f"error.{name}", vector) for name in ImuError._fields)
        assert bias is not None
        error = ImuError(bias, *others)
        std = x["std"] if self._has_std else None
        answer = Correction(x["prior"].new_zeros(1, 9), error, std=std, accepted=x["used"][:, 0] > 0.5)
        answer = answer._replace(aids=x["aids"] if self._columns else None)
        prior, posterior = _unpack_state(x["prior"]), _unpack_state(x["posterior"])
        step = Step(prior, posterior, error, x["innovation"], x["error"], answer)
        return memory._replace(numbers=vector), step

    def integrate(self, batch: Batch) -> BatchSolution:
        """Whole drives, as many at a time as torch has threads; in the precision of the batch.

        Beyond a drive's end its last state is repeated, without a fix. Many drives through a large network go through
        torch, which reads its weights once for all of them.
        """
        if len(batch.imu) >= MANY and self._is_large:
            return integrate(batch, self.estimator)
        memory, _ = self.begin(batch)
        usable = batch.gnss_valid & batch.available.unsqueeze(-1)
        value, std = (x.flatten(0, 1).double() for x in (batch.gnss, batch.gnss_std))
        aids = {name: x.flatten(0, 1).double() for name, x in batch.aids.items()}
        fixes = pack_fix(Fix(value, std, usable.flatten(0, 1), batch.gnss_lag.flatten().double(), aids), self._aids)
        fixes, imu = fixes.unflatten(0, batch.size[:2]), batch.imu.double().contiguous()

        outputs = self._run(memory.numbers, imu, fixes, batch.present.sum(1).tolist())
        x = split_outputs(torch.stack(outputs).to(batch.imu.dtype))
        return BatchSolution(
            prior=_unpack_state(x["prior"]), posterior=_unpack_state(x["posterior"]), imu_error=x["error"],
            innovation=x["innovation"] * batch.present.unsqueeze(-1), used=(x["used"][..., 0] > 0.5) & batch.present,
            std=x["std"] if self._has_std else None, gain=None,
            innovation_covariance=x["innovation_covariance"].unflatten(-1, (6, 6)),
            position_covariance=x["position_covariance"].unflatten(-1, (2, 2)),
            aids=x["aids"] if self._columns else None,
        )  # fmt: skip

    def _run(self, memory: Tensor, imu: Tensor, fixes: Tensor, epochs: list[int]) -> list[Tensor]:
        """Outputs of every drive; what a drive has in common with the one that it is a copy of is run once."""
        first, common = count_shared_epochs(memory, imu, fixes, epochs)
        splits = {b: sorted({c for f, c in zip(first, common) if f == b and c}) for b in set(first)}
        at: dict[tuple[int, int], Tensor] = {}  # memories by drive and epoch

        def run(b: int, start: Tensor, begin: int, end: int) -> tuple[Tensor, Tensor]:
            return self.library.run(start, imu[b, begin:end], fixes[b, begin:end])

        def whole(b: int) -> Tensor:
            parts, now = [], memory[b : b + 1]
            for begin, end in pairwise([0, *splits[b], epochs[b]]):
                now, outputs = run(b, now, begin, end)
                at[b, end] = now
                parts.append(outputs)
            return torch.cat(parts)

        def rest(b: int) -> Tensor:
            f, c = first[b], common[b]
            start = at[f, c] if c else memory[b : b + 1]
            return torch.cat((of_first[f][:c], run(b, start, c, epochs[b])[1]))

        firsts = sorted(splits)
        copies = [b for b in range(len(imu)) if first[b] != b]
        if len(imu) == 1 or torch.get_num_threads() == 1:
            of_first = dict(zip(firsts, map(whole, firsts)))
            of_copy = dict(zip(copies, map(rest, copies)))
        else:
            with ThreadPoolExecutor(torch.get_num_threads()) as pool:
                of_first = dict(zip(firsts, pool.map(whole, firsts)))
                of_copy = dict(zip(copies, pool.map(rest, copies)))
        outputs = [(of_first | of_copy)[b] for b in range(len(imu))]
        return [torch.cat((x, x[-1:].expand(imu.shape[1] - len(x), -1))) for x in outputs]

    @cached_property
    def _is_large(self) -> bool:
        network = self.estimator
        return isinstance(network, nn.Module) and sum(p.numel() for p in network.parameters()) > LARGE

    @property
    def _has_std(self) -> bool:
        return any(f.name.endswith(".P") for f in self.layout.fields)


def count_shared_epochs(
    memory: Float[Tensor, "B K"], imu: Float[Tensor, "B T M 6"], fixes: Float[Tensor, "B T f"], epochs: Sequence[int]
) -> tuple[list[int], list[int]]:
    """For every drive the first of those before it with its samples and start, itself without one, and how many epochs
    the two have in common until their fixes differ; 0 for itself."""
    first, common = [], []
    for b, count in enumerate(epochs):
        f = first[-1] if b else 0
        if f == b or epochs[f] != count or not (_are_equal(memory[f], memory[b]).all() and torch.equal(imu[f], imu[b])):
            first.append(b)
            common.append(0)
            continue
        differ = ~_are_equal(fixes[f], fixes[b])[:count].all(-1)
        first.append(f)
        common.append(int(differ.int().argmax()) if bool(differ.any()) else count)
    return first, common


def _reanchor(change: FrameChange, memory: Vector, fresh: Vector) -> Vector:
    """The whole memory in another tangent frame."""
    f = memory.filter
    x = move_anchor(f.estimator, f.layout.unpack(memory.numbers), f.grid, change)
    return memory._replace(numbers=f.layout.pack(x))


def _bridge(stretch: Stretch, memory: Vector, fresh: Vector) -> Vector:
    """The whole memory after a gap."""
    f = memory.filter
    x = cross_gap(f.estimator, f.layout.unpack(memory.numbers), stretch.end, stretch.seconds, f.grid)
    return memory._replace(numbers=f.layout.pack(x))


reanchoring.RULES[Vector], bridging.RULES[Vector] = _reanchor, _bridge


def compile_filter(estimator: Filter, rate_hz: float, epoch_s: float, whole: bool = False) -> CompiledFilter:
    """A filter compiled for a grid; from the cache where it has been made before.

    ``whole``: with the core of a vehicle round it (:mod:`dlkf.onboard.core`), which takes longer to make. Raises
    InputError where there is no C compiler, the cache cannot be written to, or the filter is smoothed or cannot be
    exported.
    """
    if isinstance(estimator, SmoothedSolution):
        raise InputError("a smoothed filter runs in torch, which keeps its covariances; leave compiled=true out")
    grid = Grid(round(rate_hz * epoch_s), 1 / rate_hz)
    folder = find_cache() / (_digest(estimator, grid) + ("-core" if whole else ""))
    if folder not in _LOADED:

        def make(beside: Path) -> None:
            require_compiler()  # before all the work
            write_source(beside, estimator, grid, type(estimator).__name__, {}, loop_alone=not whole)
            build(beside)

        def load(path: Path) -> tuple[Layout, Library]:
            with torch.no_grad(), without_loops():
                layout = make_layout(estimator, grid)
            return layout, Library(path, layout.size, count_output_numbers(estimator))

        _LOADED[folder] = load_cached(folder, make, load)
    return CompiledFilter(estimator, grid, *_LOADED[folder], whole=whole)


def compile_or_keep(estimator: Estimator, rate_hz: float, epoch_s: float) -> Estimator:
    """:func:`compile_filter`, or the filter itself where it cannot be compiled, with a line that says why."""
    try:
        return compile_filter(estimator, rate_hz, epoch_s)
    except InputError as error:
        warn_once(f"trials run in torch, some 3 × slower: {error}")
        return estimator


@cache
def _digest_package() -> Any:
    """Digest of this package."""
    made_of = hashlib.sha256()
    for file in sorted(Path(dlkf.__file__).parent.rglob("*")):
        if file.suffix in (".py", ".c", ".h", ".in"):
            made_of.update(file.read_bytes())
    return made_of


def _digest(estimator: Estimator, grid: Grid) -> str:
    """Of everything that the code depends on: this package, torch, the filter and its weights, grid, machine."""
    made_of = _digest_package().copy()
    code = estimator.code if isinstance(estimator, Mbkf) else estimator
    aids = find_tables(estimator)
    machine, compiler = describe_machine(), str(find_compiler())
    for part in (torch.__version__, machine, compiler, *FLAGS, repr(code), repr(grid), repr(aids)):
        made_of.update(part.encode())
    if isinstance(estimator, nn.Module):
        made_of.update(repr(getattr(estimator, "config", "")).encode())
        for name, x in sorted(estimator.state_dict().items()):
            made_of.update(name.encode() + x.detach().cpu().contiguous().numpy().tobytes())
    return made_of.hexdigest()[:32]


def _are_equal(a: Tensor, b: Tensor) -> Tensor:
    """Where they are equal, or both NaN."""
    return (a == b) | (a.isnan() & b.isnan())


def _unpack_state(x: Tensor) -> NavState:
    return NavState(x[..., :3], x[..., 3:6], x[..., 6:].unflatten(-1, (3, 3)))
