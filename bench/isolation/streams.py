"""Separate streams of random numbers: what foreign code draws or seeds does not reach the rest of the run."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from numpy.random import mtrand

from cavbench.identity.fingerprint import digest


class Stream:
    """States of the global random generators of torch, numpy and Python's `random` that are not in use at the moment.

    Args:
        seed: any values; the same values give the same numbers.
    """

    def __init__(self, *seed: object) -> None:
        number = int(digest(["stream", *seed])[:15], 16)
        self._torch = torch.Generator().manual_seed(number).get_state()
        self._python = random.Random(number).getstate()
        self._numpy: np.random.BitGenerator = np.random.MT19937(number)
        # None before the GPU is in use: its generator then goes on as it is.
        self._gpu = torch.Generator("cuda").manual_seed(number).get_state() if torch.cuda.is_initialized() else None
        self._fresh = _bytes(self._torch), self._python, _drawn(self._numpy), _bytes(self._gpu)

    @contextmanager
    def put_back(self) -> Iterator[None]:
        """What is drawn from it in here is drawn again afterwards; begin and end while it is not in use."""
        kept = self._torch, self._python, self._numpy, self._gpu
        state = self._numpy.state
        try:
            yield
        finally:
            self._torch, self._python, self._numpy, self._gpu = kept
            self._numpy.state = state

    def used(self) -> bool:
        """Whether anything was drawn from it, or it was seeded, since it was made; ask while it is not in use."""
        with self.in_use():
            return self.marks() != self._fresh

    def swap(self) -> None:
        """Exchange these states with those of the global generators; a second call changes them back."""
        in_use = torch.get_rng_state(), random.getstate(), mtrand.get_bit_generator()
        torch.set_rng_state(self._torch)
        random.setstate(self._python)
        mtrand.set_bit_generator(self._numpy)
        self._torch, self._python, self._numpy = in_use
        if torch.cuda.is_initialized():
            gpu, own = torch.cuda.get_rng_state(), self._gpu
            if own is not None:
                torch.cuda.set_rng_state(own)
            self._gpu = gpu

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """Draw from this stream; it goes on where it ended the last time."""
        self.swap()
        try:
            yield
        finally:
            self.swap()

    @staticmethod
    def marks() -> tuple[bytes, object, bytes, bytes]:
        """What tells whether anything was drawn from the global generators."""
        gpu = torch.cuda.get_rng_state() if torch.cuda.is_initialized() else None
        return _bytes(torch.get_rng_state()), random.getstate(), _drawn(mtrand.get_bit_generator()), _bytes(gpu)


@contextmanager
def put_back() -> Iterator[None]:
    """What is drawn from the global generators in here is drawn again afterwards."""
    gpu = torch.cuda.get_rng_state() if torch.cuda.is_initialized() else None
    kept, numpy = (torch.get_rng_state(), random.getstate()), mtrand.get_bit_generator()
    state = numpy.state
    try:
        yield
    finally:
        torch.set_rng_state(kept[0])
        random.setstate(kept[1])
        numpy.state = state
        mtrand.set_bit_generator(numpy)
        if gpu is not None:
            torch.cuda.set_rng_state(gpu)


def _bytes(state: torch.Tensor | None) -> bytes:
    return b"" if state is None else state.numpy().tobytes()


def _drawn(generator: np.random.BitGenerator) -> bytes:
    state = generator.state["state"]
    return (
        state["key"].tobytes() + bytes([state["pos"] % 256, state["pos"] // 256])
        if "key" in state
        else repr(state).encode()
    )
