"""Draws that belong to an episode: normal, never drawn twice, and the same in every batch."""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
import torch

from cavbench.driving.draws import Draws, given, noise
from tests.attacks.driving.victims import observations

LARGEST, GOLDEN = 2**64 - 1, 0x9E3779B97F4A7C15


def test_numbers_are_functions_of_the_episode_and_of_how_often_it_was_asked() -> None:
    keys = torch.tensor([5, 7, 11])
    together, alone = Draws(keys), Draws(keys[1:2])
    rows = torch.tensor([1, 2])
    found = torch.cat([together.numbers().view(1, 3)[:, 1], together.numbers(rows, 4).view(4, 2)[:, 0]])
    assert torch.equal(found, torch.cat([alone.numbers(copies=2), alone.numbers(copies=3)]))
    # The first episode was asked once, the others five times.
    assert not torch.equal(together.numbers()[1:], alone.numbers(copies=2))


def test_no_number_is_given_twice() -> None:
    draws = Draws(torch.arange(400))
    numbers = torch.cat([draws.numbers(copies=8), draws.numbers(torch.arange(50), copies=100), draws.numbers()])
    assert len(numbers.unique()) == len(numbers) == 400 * 8 + 5000 + 400


def test_an_episode_that_is_asked_several_times_at_once_has_a_number_for_each() -> None:
    draws, other = Draws(torch.tensor([5, 7])), Draws(torch.tensor([5, 7]))
    numbers = draws.numbers(torch.tensor([0, 0, 0, 1]), 2)
    assert len(numbers.unique()) == 8
    assert torch.equal(numbers.view(2, 4)[:, :3].flatten(), other.numbers(torch.tensor([0]), 6))
    assert torch.equal(draws.numbers()[:1], other.numbers()[:1])


def test_two_draws_of_one_answer_are_not_the_same() -> None:
    seen = torch.zeros(2000, 3, 3)
    with given(Draws(torch.tensor([3])).numbers(copies=len(seen))) as found:
        first, second = noise(seen), noise(seen)
    assert found is not None
    assert found.calls == 2
    assert abs(float((first * second).mean())) < 4 / math.sqrt(first.numel())
    assert abs(float(second.square().mean()) - 1) < 8 / math.sqrt(first.numel())


def test_noise_is_normal() -> None:
    seen = torch.zeros(20_000, 3, 5)
    with given(Draws(torch.tensor([3])).numbers(copies=len(seen))):
        values = noise(seen).flatten(1).double()
    largest = 4 / math.sqrt(values.numel())
    assert abs(float(values.mean())) < largest
    assert abs(float(values.square().mean()) - 1) < 2 * largest
    assert abs(float(values.pow(4).mean()) - 3) < 10 * largest
    between = values.T @ values / len(values) - torch.eye(12, dtype=torch.float64)
    assert float(between.abs().max()) < 6 / math.sqrt(len(values))
    # Kolmogorov and Smirnov: a distance of 2 / sqrt(n) has a probability of 0.07 %.
    ordered = np.sort(values.flatten().numpy())
    below = np.array([NormalDist().cdf(value) for value in ordered[::50]])
    assert np.abs(below - np.arange(0, len(ordered), 50) / len(ordered)).max() < 2 / math.sqrt(len(ordered))


def _mixed(value: int) -> int:
    value = ((value ^ (value >> 30)) * 0xBF58476D1CE4E5B9) & LARGEST
    value = ((value ^ (value >> 27)) * 0x94D049BB133111EB) & LARGEST
    return value ^ (value >> 31)


def test_noise_is_splitmix_and_box_and_muller() -> None:
    number = 123_456_789_012_345
    expected = []
    for pair in range(4):
        bits = _mixed((number + (pair + 1) * GOLDEN) & LARGEST)
        turn = bits & 0xFFFFFFFF
        angle = (turn - 2**32 if turn >= 2**31 else turn) / 2**31 * math.pi
        length = math.sqrt(-2 * math.log(((bits >> 32) + 1) / 2**32))
        expected.append((length * math.cos(angle), length * math.sin(angle)))
    with given(torch.tensor([number])):
        found = noise(torch.zeros(1, 2, 5)).flatten()
    torch.testing.assert_close(
        found.double(), torch.tensor(expected, dtype=torch.float64).T.flatten(), atol=2e-6, rtol=0
    )


def test_noise_has_the_same_bits_in_every_batch_and_place() -> None:
    seen, numbers = observations(300, 0), Draws(torch.arange(300)).numbers()
    with given(numbers):
        whole = noise(seen)
    order = torch.randperm(300, generator=torch.Generator().manual_seed(0))
    for rows in (order, order[:1], order[:65], order[3:80]):
        with given(numbers[rows]):
            assert torch.equal(noise(seen[rows]), whole[rows])
    with given(numbers):
        assert torch.equal(noise(seen.view(3, 100, *seen.shape[1:])), whole.view(3, 100, *whole.shape[1:]))
    with given(numbers[:1]):
        assert noise(torch.zeros(1, 3, 2)).shape == (1, 3, 1)


def test_each_point_of_a_filter_has_noise_of_its_own_in_every_batch() -> None:
    seen, numbers = observations(40, 0), Draws(torch.arange(40)).numbers()
    points = seen.expand(16, *seen.shape)
    with given(numbers):
        whole = noise(points)
    assert len(whole.flatten(2).flatten(0, 1)[:, 0].unique()) == 16 * 40
    with given(numbers):
        assert torch.equal(whole[0], noise(seen))
    for rows in (torch.tensor([7]), torch.arange(3, 20)):
        with given(numbers[rows]):
            assert torch.equal(noise(points[:, rows]), whole[:, rows])
    between = whole.flatten(1).double() @ whole.flatten(1).double().T / whole[0].numel() - torch.eye(16)
    assert float(between.abs().max()) < 6 * math.sqrt(2 / whole[0].numel())


def test_without_a_number_for_each_observation_the_process_draws() -> None:
    seen = torch.zeros(4, 10, 5)
    torch.manual_seed(0)
    usual = torch.randn_like(seen[..., 1:])
    for numbers in (None, torch.arange(3), torch.arange(40)):
        torch.manual_seed(0)
        with given(numbers):
            assert torch.equal(noise(seen), usual)
