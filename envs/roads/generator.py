"""numpy's random numbers in compiled code: SeedSequence, PCG64 and the methods of Generator that highway-env calls.

A generator is an array uint64 [6]: state (high, low), increment (high, low), whether half a word is stored, and that half.
Every function gives the numbers of `numpy.random.default_rng(seed)`, bit for bit (numpy 2; tests/envs/roads/test_generator.py).
"""

from __future__ import annotations

import math

import numpy as np
from numba.np.random._constants import fi_double, ki_double, wi_double, ziggurat_nor_inv_r, ziggurat_nor_r
from numpy.typing import NDArray

from cavbench.compiled import inner

Generator = NDArray[np.uint64]

WORDS = 6
LOW_HALF = np.uint64(0xFFFFFFFF)
MULTIPLIER_HIGH, MULTIPLIER_LOW = np.uint64(2549297995355413924), np.uint64(4865540595714422341)
"""PCG64's multiplier (O'Neill 2014)."""
UNIT_PER_BIT = 1.0 / 2**53
LAYER_HEIGHT, LAYER_EDGE, LAYER_WIDTH = fi_double, ki_double, wi_double
TAIL, TAIL_INVERSE = float(ziggurat_nor_r), float(ziggurat_nor_inv_r)
"""The tables of numpy's normal distribution (numpy/random/src/distributions/ziggurat_constants.h), of which numba has a copy."""
POOL = 4
"""Words in the pool of numpy's SeedSequence; its other constants are those of numpy/random/bit_generator.pyx."""


@inner
def high_product(first: np.uint64, second: np.uint64) -> np.uint64:
    """The upper 64 bits of a product of two words."""
    half = np.uint64(32)
    first_low, first_high = first & LOW_HALF, first >> half
    second_low, second_high = second & LOW_HALF, second >> half
    middle = first_high * second_low + ((first_low * second_low) >> half)
    other = first_low * second_high + (middle & LOW_HALF)
    return first_high * second_high + (middle >> half) + (other >> half)


@inner
def advance_state(generator: Generator) -> None:
    """One step of the 128-bit linear congruential generator."""
    high, low = generator[0], generator[1]
    new_low = low * MULTIPLIER_LOW
    new_high = high_product(low, MULTIPLIER_LOW) + high * MULTIPLIER_LOW + low * MULTIPLIER_HIGH
    total = new_low + generator[3]
    carry = np.uint64(1) if total < new_low else np.uint64(0)
    generator[0], generator[1] = new_high + generator[2] + carry, total


@inner
def next_word(generator: Generator) -> np.uint64:
    """64 random bits (PCG64.random_raw)."""
    advance_state(generator)
    value = generator[0] ^ generator[1]
    turn = generator[0] >> np.uint64(58)
    return (value >> turn) | (value << ((np.uint64(64) - turn) & np.uint64(63)))


@inner
def next_half_word(generator: Generator) -> np.uint64:
    """32 random bits: the low half of a word first, its high half in the next call."""
    if generator[4]:
        generator[4] = np.uint64(0)
        return generator[5]
    word = next_word(generator)
    generator[4], generator[5] = np.uint64(1), word >> np.uint64(32)
    return word & LOW_HALF


@inner
def next_double(generator: Generator) -> float:
    """Generator.random."""
    return np.float64(next_word(generator) >> np.uint64(11)) * UNIT_PER_BIT


@inner
def next_uniform(generator: Generator, low: float, high: float) -> float:
    """Generator.uniform(low, high)."""
    return low + (high - low) * next_double(generator)


@inner
def next_normal(generator: Generator) -> float:
    """Generator.normal(): the ziggurat of Marsaglia and Tsang (2000) with numpy's tables."""
    while True:
        word = next_word(generator)
        layer = np.int64(word & np.uint64(0xFF))
        share = (word >> np.uint64(9)) & np.uint64(0x000FFFFFFFFFFFFF)
        value = np.float64(share) * LAYER_WIDTH[layer]
        if (word >> np.uint64(8)) & np.uint64(1):
            value = -value
        if share < LAYER_EDGE[layer]:
            return value
        if layer > 0:
            between = (LAYER_HEIGHT[layer - 1] - LAYER_HEIGHT[layer]) * next_double(generator) + LAYER_HEIGHT[layer]
            if between < math.exp(-0.5 * value * value):
                return value
            continue
        while True:
            beyond = -TAIL_INVERSE * math.log1p(-next_double(generator))
            height = -math.log1p(-next_double(generator))
            if height + height > beyond * beyond:
                return -(TAIL + beyond) if (share >> np.uint64(8)) & np.uint64(1) else TAIL + beyond


@inner
def next_below(generator: Generator, bound: int) -> np.int64:
    """Generator.integers(bound) and Generator.choice(bound): Lemire's method on 32 bits; no bits are used for a bound of 1."""
    if bound <= 1:
        return np.int64(0)
    limit = np.uint64(bound)
    product = next_half_word(generator) * limit
    threshold = (np.uint64(2**32) - limit) % limit
    while (product & LOW_HALF) < threshold:
        product = next_half_word(generator) * limit
    return np.int64(product >> np.uint64(32))


@inner
def next_pair(generator: Generator) -> tuple[np.int64, np.int64]:
    """Generator.choice(4, size=2, replace=False): Floyd's method, then a shuffle."""
    first, second = next_below(generator, 3), next_below(generator, 4)
    if second == first:
        second = np.int64(3)
    if next_below(generator, 2) == 0:
        return second, first
    return first, second


@inner
def hash_word(value: np.uint64, constant: NDArray[np.uint64]) -> np.uint64:
    """SeedSequence's hashmix on 32 bits; `constant` [1] is updated."""
    value = (value ^ constant[0]) & LOW_HALF
    constant[0] = (constant[0] * np.uint64(0x931E8875)) & LOW_HALF
    value = (value * constant[0]) & LOW_HALF
    return value ^ (value >> np.uint64(16))


@inner
def mix_words(first: np.uint64, second: np.uint64) -> np.uint64:
    """SeedSequence's mix on 32 bits."""
    value = (np.uint64(0xCA01F9DD) * first - np.uint64(0x4973F715) * second) & LOW_HALF
    return value ^ (value >> np.uint64(16))


@inner
def seed_words(seed: int, words: NDArray[np.uint64]) -> None:
    """SeedSequence(seed).generate_state(4, uint64) into `words` [4]."""
    entropy = np.uint64(seed)
    pool, constant = np.zeros(POOL, np.uint64), np.zeros(1, np.uint64)
    constant[0] = np.uint64(0x43B0D7E5)
    pool[0] = hash_word(entropy & LOW_HALF, constant)
    pool[1] = hash_word(entropy >> np.uint64(32), constant)
    pool[2] = hash_word(np.uint64(0), constant)
    pool[3] = hash_word(np.uint64(0), constant)
    for source in range(POOL):
        for target in range(POOL):
            if source != target:
                pool[target] = mix_words(pool[target], hash_word(pool[source], constant))
    mask = np.uint64(0x8B51F9DD)
    for number in range(2 * POOL):
        value = (pool[number % POOL] ^ mask) & LOW_HALF
        mask = (mask * np.uint64(0x58F38DED)) & LOW_HALF
        value = (value * mask) & LOW_HALF
        value = value ^ (value >> np.uint64(16))
        if number % 2 == 0:
            words[number // 2] = value
        else:
            words[number // 2] |= value << np.uint64(32)


@inner
def seed_generator(generator: Generator, seed: int) -> None:
    """Start as `gymnasium.utils.seeding.np_random(seed)` does; `seed` is a whole number of at least 0."""
    words = np.zeros(4, np.uint64)
    seed_words(seed, words)
    generator[0] = generator[1] = np.uint64(0)
    generator[2] = (words[2] << np.uint64(1)) | (words[3] >> np.uint64(63))
    generator[3] = (words[3] << np.uint64(1)) | np.uint64(1)
    advance_state(generator)
    low = generator[1] + words[1]
    carry = np.uint64(1) if low < words[1] else np.uint64(0)
    generator[0], generator[1] = generator[0] + words[0] + carry, low
    advance_state(generator)
    generator[4] = generator[5] = np.uint64(0)
