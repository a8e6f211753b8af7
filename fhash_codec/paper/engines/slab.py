"""The slab engine: training and evaluation on the lattice by small separable matrix products.

A training sample is a lattice vertex. Its embedding at the finest level is therefore one entry of
the table, and every coarser level is a separable linear upsampling of a small sub-lattice; no 16
corners are looked up per sample. The unit of work is a brick of vertices of one key frame, and a
batch is a random set of bricks. The same code runs on a CPU and on CUDA; there the host never waits
for a step, sends it one message (`Sender`), and launches it as one graph (`StepGraphs`).

The finest embeddings are stored for the samples alone, brick by brick. Adam visits just the bricks
of a batch, yet gives what a dense Adam gives: a brick that was passed over catches up on its
missing steps, whose gradient is zero, in closed form before it is used (`training.adam.catch_up`).
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from math import prod
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from fhash_codec.devices import first_line
from fhash_codec.features.bricks import Coreset
from fhash_codec.paper.engines.parameters import (
    CatchUp,
    Chosen,
    Lattices,
    Parameters,
    Upsampling,
    adam_step,
    adam_step_on_device,
    catch_up,
    catch_up_numbers,
    check_state,
    corrections,
    initial_parameters,
    layer_matrices,
    true_positions,
)
from fhash_codec.paper.network import Architecture
from fhash_formats.errors import FhashWarning


class Columns(NamedTuple):
    """The columns of a batch: all vertices of its bricks, or their samples alone.

    Around a feature most vertices of many bricks are no samples.

    Attributes:
        bricks: number of the bricks.
        ranks: place of each column among the samples of the coreset, int64 (columns,); of one that
            is no sample the place behind them all.
        vertices: number of its vertex among those of the bricks, int64 (columns,); None where all
            vertices are columns.
        in_coreset: which columns are samples, as 0 and 1 (columns,); None where all are.
    """

    bricks: int
    ranks: Tensor
    vertices: Tensor | None
    in_coreset: Tensor | None


def columns_of(in_coreset: Tensor, offsets: Tensor, none: int, alone: int | None) -> Columns:
    """Return the columns of some bricks.

    Args:
        in_coreset: which vertices (bricks, vertices) are samples, as 0 and 1.
        offsets: place of each brick's first sample (bricks,).
        none: place that stands for vertices that are no samples.
        alone: number of the samples, where they alone are columns; else None.
    """
    bricks = len(in_coreset)
    ranks = in_coreset.cumsum(1, dtype=torch.int64).add_(offsets.unsqueeze(1) - 1).view(-1)
    mask = in_coreset.reshape(-1)
    if alone is None:
        return Columns(bricks, ranks.masked_fill_(mask == 0, none), None, mask)
    vertices = true_positions(mask, alone)
    return Columns(bricks, ranks[vertices], vertices, None)


WARM_UPS = 2
"""Steps of a shape that run kernel by kernel before one is captured: libraries start up in them."""
MAX_GRAPHS = 64
"""Shapes that are captured, at most; each holds the memory of a step's results."""


class StepGraphs:
    """The captured steps by their shape.

    A step must read whatever changes from one step to the next from the same memory at each call,
    and write to the same memory, but for its result.
    """

    def __init__(self) -> None:
        self._captured: dict[Hashable, tuple[Any, Tensor]] = {}
        self._seen: Counter[Hashable] = Counter()
        self._failed = False

    def run(self, shape: Hashable, step: Callable[[], Tensor]) -> Tensor:
        """Do a step and return its result, a tensor of its own.

        The third step of a shape is captured. Where that fails, this and all later steps run kernel
        by kernel, with one FhashWarning.
        """
        if shape not in self._captured:
            self._seen[shape] += 1
            early = self._seen[shape] <= WARM_UPS
            if early or self._failed or len(self._captured) == MAX_GRAPHS:
                return step()
            try:
                self._captured[shape] = self._capture(step)
            except RuntimeError as error:
                self._failed = True
                warnings.warn(
                    f"no CUDA graph of a training step ({first_line(error)}); training goes on "
                    "kernel by kernel, which is slower",
                    FhashWarning,
                    stacklevel=3,
                )
                return step()
        graph, result = self._captured[shape]
        graph.replay()
        return result.clone()

    def _capture(self, step: Callable[[], Tensor]) -> tuple[Any, Tensor]:
        """Return the graph of a step, and where its result lies after each replay."""
        graph = torch.cuda.CUDAGraph()
        # Graphs share their memory: one runs after the other, and each result is copied at once.
        pool = next(iter(self._captured.values()))[0].pool() if self._captured else None
        with torch.cuda.graph(graph, pool=pool):
            result = step()
        return graph, result


@dataclass(frozen=True, kw_only=True)
class Sent:
    """A batch of bricks and the numbers of its step, on the device.

    Attributes:
        ids: numbers of the bricks, int64 (bricks,).
        caught_up: the columns of `adam.CatchUp`, float32 (4, bricks).
        correction: `adam.corrections`' factor of the root, float32 ().
        pace: `adam.corrections`' pace, float32 ().
        scale: factor of the gradients, float32 ().
    """

    ids: Tensor
    caught_up: Tensor
    correction: Tensor
    pace: Tensor
    scale: Tensor


class Sender:
    """Memory on a device for the numbers of steps, one piece for each number of bricks.

    On CUDA the numbers go through pinned memory, so that the host does not wait, and always to the
    same place for a batch of one size, so that a captured graph finds them there.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._memory: dict[int, Tensor] = {}

    def send(
        self,
        chosen: npt.NDArray[np.int64],
        columns: CatchUp,
        scalars: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> Sent:
        """Return a step's numbers on the device. The next call with as many bricks overwrites them.

        Args:
            chosen: numbers of the bricks, int64 (bricks,).
            columns: effect of the steps that the bricks were passed over.
            scalars: correction, pace and scale.
        """
        count = len(chosen)
        # The int64 come first: so all numbers lie at multiples of their own size.
        parts = (np.ascontiguousarray(chosen), *columns, np.array(scalars, dtype=np.float32))
        received = self._received(np.concatenate([part.view(np.uint8) for part in parts]), count)
        numbers = received[8 * count :].view(torch.float32)
        correction, pace, scale = numbers[4 * count :].unbind()
        return Sent(
            ids=received[: 8 * count].view(torch.int64),
            caught_up=numbers[: 4 * count].view(4, count),
            correction=correction,
            pace=pace,
            scale=scale,
        )

    def _received(self, packed: npt.NDArray[np.uint8], count: int) -> Tensor:
        """Return bytes on the device."""
        if self._device.type == "cpu":
            return torch.from_numpy(packed)
        if count not in self._memory:
            self._memory[count] = torch.empty(len(packed), dtype=torch.uint8, device=self._device)
        # Fresh at each step: torch hands pinned memory out again only after its copy is done.
        pinned = torch.empty(len(packed), dtype=torch.uint8, pin_memory=True)
        pinned.numpy()[:] = packed
        return self._memory[count].copy_(pinned, non_blocking=True)


LIBRARIES = 1 << 28
"""Bytes for the libraries of CUDA: their code and the workspaces of matrix products."""
UNEVEN = 2
"""Largest number of bricks of a batch, as a multiple of the mean: batches have as many samples."""
TIMES = 2
"""Copies of a step's memory: captured graphs hold theirs beside that of the first steps."""


def needed_bytes(architecture: Architecture, coreset: Coreset, batches: int) -> int:
    """Return about how many bytes a training takes, rather too many than too few.

    Args:
        architecture: the sizes of the model.
        coreset: the training samples.
        batches: batches of an epoch.
    """
    bricks, vertices = len(coreset.bricks), prod(coreset.brick_shape)
    samples = len(coreset.values) + 1
    size = architecture.embedding_size
    coarse = architecture.coarse_numbers
    network = sum(outputs * (inputs + 1) for outputs, inputs in architecture.layer_shapes)
    # Embeddings, mean and square of the finest level; values, masks, offsets and coordinates.
    held = 12 * size * samples + 4 * samples + coreset.mask_bits.nbytes
    held += bricks * (8 + 4 * 8)
    # Four vectors of the numbers in use, their places, rank, mask, and the initial tables.
    held += coarse * (4 * 4 + 8 + 4 + 1 + 4) + 16 * network
    batch = min(UNEVEN * -(-bricks // batches), bricks)
    return LIBRARIES + held + TIMES * batch * vertices * _bytes_a_vertex(architecture)


def _bytes_a_vertex(architecture: Architecture) -> int:
    """Return the bytes that a training step holds for each vertex of its bricks."""
    inputs = architecture.inputs
    hidden = sum(outputs + 1 for outputs, _ in architecture.layer_shapes[:-1])
    # Inputs and their gradients, each also for samples alone; activations and their gradients.
    numbers = 4 * (inputs + 1) + 2 * hidden
    # Rows of the finest level, what Adam makes of them and the effect of missed steps, products of
    # the interpolation, target, residual and its square.
    numbers += 7 * architecture.embedding_size + 4 + 3 * architecture.embedding_size + 4
    # Mask, its bits and sums, ranks, places of the samples and their bricks.
    return 4 * numbers + 2 + 5 * 8


CHUNK = 1 << 13
"""Samples that go through the MLP at a time: their activations stay in a core's cache.

On CUDA all of a batch do: a launch costs more than a pass through the memory.
"""
FULL = 0.9
"""Share of samples among the vertices of a batch above which all vertices go through the MLP.

To pick a sample moves a few numbers; the MLP multiplies thousands for it.
"""
ADAM_PART = 1 << 17
"""Numbers of the flat vector that Adam moves at a time on a CPU: they stay in the cache."""
STATE = ("fine", "fine_mean", "fine_square", "flat", "flat_mean", "flat_square")
"""Tensors that a checkpoint stores, by name, besides `visited` and the step."""
FLUSH = 1024
"""Bricks that are brought up to date at a time."""


class SlabEngine:
    """An `Engine` that trains on bricks.

    Attributes:
        fine: finest embeddings (E, samples) in the order of `Coreset.values`; `fine_mean` and
            `fine_square` are their moments of Adam.
        visited: number of the last training step that used each brick, 0 for none, int64 (bricks,)
            on the host.
        flat: the used numbers of the coarse tables, followed by the layers of the MLP, in one
            vector; `flat_mean` and `flat_square` are their moments, `gradient` is their gradient.
        coarse: number of the used numbers of the coarse tables.
        layers: matrices (out, in + 1) of the MLP, views of `flat`; `layer_gradients` are views of
            `gradient`.
        settled: number of the training step up to which all bricks have caught up.
    """

    name = "slab"

    def __init__(
        self,
        architecture: Architecture,
        coreset: Coreset,
        rates: npt.NDArray[np.float64],
        *,
        seed: int,
        device: torch.device,
    ) -> None:
        """Start from fresh parameters; arguments as in `make_engine`.

        The coreset is copied to the device.
        """
        self.architecture, self.coreset = architecture, coreset
        self.rates, self.device = rates, device
        self.on_cpu = device.type == "cpu"
        self.vertices, self.counts = prod(coreset.brick_shape), np.diff(coreset.offsets)
        self.bricks = torch.from_numpy(coreset.bricks.astype(np.int64)).to(device)
        self.mask_bits = torch.from_numpy(coreset.mask_bits).to(device)
        # A sample more, which stands for every vertex that is none.
        self.values = torch.zeros(len(coreset.values) + 1, device=device)
        self.values[:-1] = torch.from_numpy(coreset.values)
        self.offsets = torch.from_numpy(coreset.offsets).to(device)
        self._bits = torch.arange(7, -1, -1, device=device, dtype=torch.uint8)
        self._scratch_memory: dict[str, Tensor] = {}
        self._sender, self._graphs = Sender(device), StepGraphs()
        self.upsampling = Upsampling(architecture, coreset, device)

        start = initial_parameters(architecture, coreset, seed)
        # Embeddings and both moments. They stay 0 for the sample that stands for no sample.
        self._numbers = torch.zeros(3, len(start.fine), len(self.values), device=device)
        self.fine, self.fine_mean, self.fine_square = self._numbers[..., :-1].unbind()
        self.fine.copy_(start.fine)
        self.visited = np.zeros(len(self.bricks), dtype=np.int64)
        self.step = self.settled = 0
        self.coarse = len(self.upsampling.used)
        self.flat = torch.cat(
            [start.coarse.to(device)[self.upsampling.used], start.network.to(device)]
        )
        self.flat_mean, self.flat_square, self.gradient = (
            torch.zeros_like(self.flat) for _ in range(3)
        )
        self.layers = layer_matrices(architecture, self.flat[self.coarse :])
        self.layer_gradients = layer_matrices(architecture, self.gradient[self.coarse :])

    @torch.no_grad()
    def train(self, chosen: Chosen) -> Tensor:
        """Do one training step on a batch; return the sum of squared errors before it."""
        samples = int(self.counts[chosen].sum())
        self.step += 1
        sent = self._sender.send(
            chosen,
            catch_up(self.visited[chosen], self.step - 1, self.rates),
            (*corrections(self.step, float(self.rates[self.step])), 2.0 / max(samples, 1)),
        )
        if self.on_cpu:
            error = self._step(sent, samples)
        else:
            picked = samples if self._is_sparse(samples, len(chosen)) else None
            error = self._graphs.run((len(chosen), picked), lambda: self._step(sent, samples))
        self.visited[chosen] = self.step
        return error

    def _step(self, sent: Sent, samples: int) -> Tensor:
        """Do a training step on the device; return the sum of squared errors before it.

        Args:
            sent: the batch.
            samples: samples of the batch.
        """
        columns = self._columns(sent.ids, samples)
        numbers = self._caught_up(sent, columns)
        lattices = self.upsampling.lattices(self.bricks[sent.ids])
        inputs = self._inputs(lattices, numbers[0], columns)
        self.gradient.zero_()
        error, input_gradient = self._backpropagate(inputs, columns, sent.scale)
        size = len(self.fine)
        level_gradients = self._at_all_vertices(input_gradient[size:], columns)
        lattices.add_transposed(self.gradient, self._by_level(level_gradients))

        fine, mean, square = numbers
        self._move((fine, input_gradient[:size], mean, square), sent)
        vectors = (self.flat, self.gradient, self.flat_mean, self.flat_square)
        for part in self._chunks(len(self.flat), ADAM_PART):
            self._move(tuple(vector[part] for vector in vectors), sent)
        self._numbers.index_copy_(2, columns.ranks, numbers)
        return error

    @torch.no_grad()
    def infer(self, chosen: Chosen) -> Tensor:
        """Return the values (n,) at the samples of some bricks."""
        sent, count = self._sent(chosen), int(self.counts[chosen].sum())
        columns = self._columns(sent.ids, count)
        if self.settled == self.step:
            fine = self._numbers[0].index_select(1, columns.ranks)
        else:
            fine = self._caught_up(sent, columns)[0]
        lattices = self.upsampling.lattices(self.bricks[sent.ids])
        values = self._value(self._inputs(lattices, fine, columns))
        if columns.in_coreset is None:
            return values
        return values[true_positions(columns.in_coreset, count)]

    @torch.no_grad()
    def settle(self) -> None:
        """Let every brick catch up with the present step, so that evaluation is faster."""
        for first in range(0, len(self.bricks), FLUSH):
            end = min(first + FLUSH, len(self.bricks))
            span = slice(*self.coreset.offsets[[first, end]].tolist())
            effect = self._sent(np.arange(first, end)).caught_up.repeat_interleave(
                self.offsets[first : end + 1].diff(), dim=1, output_size=span.stop - span.start
            )
            catch_up_numbers(self._numbers[..., span], effect)
        self.visited[self.visited > 0] = self.step
        self.settled = self.step

    @torch.no_grad()
    def parameters(self) -> Parameters:
        """Return the trained numbers, on the CPU. Embeddings that no sample ever moved are 0.

        On a CPU the finest embeddings are the engine's own memory, not a copy.
        """
        self.settle()
        coarse = torch.zeros(self.architecture.coarse_numbers)
        moved = (self.flat_mean != 0) | (self.flat_square != 0)
        used = torch.where(moved, self.flat, 0.0) if self.step else self.flat
        coarse[self.upsampling.used.cpu()] = used[: self.coarse].cpu()
        return Parameters(
            fine=self.fine.cpu(), coarse=coarse, network=self.flat[self.coarse :].cpu().clone()
        )

    def state(self) -> dict[str, npt.NDArray[np.generic]]:
        """Return parameters, Adam's moments and the step number as arrays."""
        tensors = {name: getattr(self, name).cpu().numpy() for name in STATE}
        return {"step": np.array(self.step), "visited": self.visited, **tensors}

    def restore(self, state: Mapping[str, npt.NDArray[np.generic]]) -> None:
        """Continue from a `state`; raises KeyError or ValueError for one of another model."""
        check_state(state, {name: getattr(self, name).shape for name in (*STATE, "visited")})
        self.step, self.settled = int(state["step"]), -1
        self.visited[:] = state["visited"]
        for name in STATE:
            getattr(self, name).copy_(torch.from_numpy(state[name]))

    def _sent(self, chosen: Chosen) -> Sent:
        """Return bricks on the device, with what they missed up to the present step."""
        return self._sender.send(chosen, catch_up(self.visited[chosen], self.step, self.rates))

    def _columns(self, ids: Tensor, samples: int) -> Columns:
        """Return the columns of the MLP's inputs for bricks that have so many samples."""
        alone = samples if self._is_sparse(samples, len(ids)) else None
        return columns_of(self._in_coreset(ids), self.offsets[ids], len(self.values) - 1, alone)

    def _caught_up(self, sent: Sent, columns: Columns) -> Tensor:
        """Return what a dense Adam has for columns of bricks that missed steps.

        The numbers (3, E, columns) are the finest embeddings, their mean and their square.
        """
        numbers = self._numbers.index_select(2, columns.ranks)
        if columns.vertices is None:
            effect = sent.caught_up.unsqueeze(2).expand(-1, -1, self.vertices).reshape(4, -1)
        else:
            effect = sent.caught_up[:, columns.vertices // self.vertices]
        catch_up_numbers(numbers, effect)
        return numbers

    def _is_sparse(self, samples: int, bricks: int) -> bool:
        """Return whether a batch has so few samples that the MLP takes them alone."""
        return samples <= FULL * bricks * self.vertices

    def _in_coreset(self, ids: Tensor) -> Tensor:
        """Return which vertices (bricks, vertices) are in the coreset, as 0 and 1, uint8."""
        return (self.mask_bits[ids].unsqueeze(-1) >> self._bits & 1).flatten(1)[:, : self.vertices]

    def _inputs(self, lattices: Lattices, fine: Tensor, columns: Columns) -> Tensor:
        """Return the inputs of the MLP (levels E + 1, columns).

        The last row is 1: the layers' biases are one more column of their matrices. The next call
        overwrites the result.

        Args:
            lattices: the sub-lattices of the bricks.
            fine: finest embeddings (E, columns).
            columns: the columns.
        """
        inputs = self._scratch("inputs", self.architecture.inputs + 1, fine.shape[1])
        inputs[: len(fine)], inputs[-1] = fine, 1.0
        coarse = inputs[len(fine) : -1]
        if columns.vertices is None:
            lattices.interpolate(self.flat, self._by_level(coarse))
        else:
            whole = self._scratch("coarse inputs", len(coarse), columns.bricks * self.vertices)
            lattices.interpolate(self.flat, self._by_level(whole))
            torch.index_select(whole, 1, columns.vertices, out=coarse)
        return inputs

    def _at_all_vertices(self, rows: Tensor, columns: Columns) -> Tensor:
        """Return rows (n, columns) as rows over all vertices of the bricks, with 0 between them."""
        if columns.vertices is None:
            return rows
        whole = self._scratch("whole gradient", len(rows), columns.bricks * self.vertices)
        return whole.zero_().index_copy_(1, columns.vertices, rows)

    def _by_level(self, rows: Tensor) -> Tensor:
        """Return rows (coarse levels * E, vertices) as (coarse levels, E, bricks, z, y, x)."""
        levels, size = len(self.architecture.levels) - 1, self.architecture.embedding_size
        bricks = rows.shape[1] // self.vertices
        return rows.view(levels, size, bricks, *self.coreset.brick_shape)

    def _value(self, inputs: Tensor) -> Tensor:
        """Return the output of the MLP (samples,)."""
        result = torch.empty(inputs.shape[1], device=self.device)
        for part in self._chunks(len(result), CHUNK):
            result[part] = self._forward(inputs[:, part])[-1][0]
        return result

    def _chunks(self, count: int, most: int) -> list[slice]:
        """Return slices of `count` numbers, each of at most `most` on a CPU; one of all on CUDA."""
        size = most if self.on_cpu else max(count, 1)
        return [slice(first, first + size) for first in range(0, count, size)]

    def _move(self, tensors: tuple[Tensor, ...], sent: Sent) -> None:
        """Do a step of Adam on parameters, their gradient and its moments."""
        parameter, gradient, mean, square = tensors
        if self.on_cpu:
            rate = float(self.rates[self.step])
            adam_step(parameter, gradient, mean, square, self.step, rate)
        else:
            adam_step_on_device(parameter, gradient, mean, square, sent.correction, sent.pace)

    def _forward(self, inputs: Tensor) -> list[Tensor]:
        """Return the activations of each layer for a chunk of samples, the inputs first.

        The next call overwrites them.
        """
        count = inputs.shape[1]
        activations = [inputs]
        for number, layer in enumerate(self.layers):
            if number == len(self.layers) - 1:
                activations.append(layer @ activations[-1])
            else:
                # The last row stays 1: it carries the bias of the next layer.
                hidden = self._scratch(f"hidden {number}", len(layer) + 1, count)
                hidden[-1] = 1.0
                torch.mm(layer, activations[-1], out=hidden[:-1]).clamp_min_(0.0)
                activations.append(hidden)
        return activations

    def _backpropagate(
        self, inputs: Tensor, columns: Columns, scale: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the sum of squared errors, and the gradient of scale/2 times it by the inputs.

        The gradients of the layers are added to `layer_gradients`.

        Args:
            inputs: inputs of the MLP (levels E + 1, columns).
            columns: the columns.
            scale: factor of the gradients, of no axis.
        """
        gradient = self._scratch("gradient", self.architecture.inputs, inputs.shape[1])
        error = torch.zeros((), dtype=torch.float64, device=self.device)
        target = self.values[columns.ranks]
        for part in self._chunks(inputs.shape[1], CHUNK):
            activations = self._forward(inputs[:, part])
            residual = activations[-1][0] - target[part]
            if columns.in_coreset is not None:
                residual.mul_(columns.in_coreset[part])
            error += residual.square().sum(dtype=torch.float64)
            back = residual.mul_(scale).unsqueeze(0)
            for number in range(len(self.layers) - 1, -1, -1):
                self.layer_gradients[number].addmm_(back, activations[number].T)
                weight = self.layers[number][:, :-1]
                if number == 0:
                    torch.mm(weight.T, back, out=gradient[:, part])
                else:
                    down = self._scratch(f"back {number}", weight.shape[1], back.shape[1])
                    torch.mm(weight.T, back, out=down)
                    hidden = activations[number][:-1]
                    back = torch.ops.aten.threshold_backward.grad_input(
                        down, hidden, 0.0, grad_input=down
                    )
        return error, gradient

    def _scratch(self, name: str, rows: int, columns: int) -> Tensor:
        """Return an uninitialised matrix, on a CPU in the same memory at every call with a name.

        Fresh pages would cost more than the arithmetic on them. On CUDA torch keeps freed memory
        itself, and a captured graph must not refer to memory that a larger batch replaces.
        """
        if not self.on_cpu:
            return torch.empty(rows, columns, device=self.device)
        memory = self._scratch_memory.get(name)
        if memory is None or len(memory) < rows * columns:
            memory = self._scratch_memory[name] = torch.empty(rows * columns, device=self.device)
        return memory[: rows * columns].view(rows, columns)
