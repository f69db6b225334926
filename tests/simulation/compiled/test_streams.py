"""Streams are NumPy's SFC64, and the variates drawn from them follow their laws."""

import numpy as np
import pytest
from numba import njit
from scipy.stats import kstest, norm

from certbound.simulation.compiled.streams import (
    draw_normal,
    draw_sign,
    draw_uniform,
    next_word,
    seed_stream,
    start_generator,
    uniform,
)


def filler(draw):
    @njit
    def fill(stream, out):
        a, b, c, w = stream[4], stream[5], stream[6], stream[7]
        for j in range(len(out)):
            out[j], a, b, c, w = draw(a, b, c, w)

    return fill


fill_normal, fill_uniform, fill_sign = filler(draw_normal), filler(draw_uniform), filler(draw_sign)


def test_a_stream_yields_the_words_of_numpys_sfc64():
    stream = seed_stream(2024, 7)
    generator = np.random.SFC64(np.random.SeedSequence(2024, spawn_key=(7, 1)))
    assert [int(next_word(stream)) for _ in range(50)] == [int(word) for word in generator.random_raw(50)]
    noise = np.random.SFC64(np.random.SeedSequence(2024, spawn_key=(7, 2)))
    assert stream[4:].tolist() == noise.state["state"]["state"].tolist()


def test_streams_differ_between_blocks_seeds_and_from_the_generator_of_starts():
    words = {tuple(seed_stream(seed, block)) for seed in (1, 2) for block in range(20)}
    start = start_generator(1, 0).bit_generator.state["state"]["state"]
    assert len(words) == 40
    assert tuple(start) not in words


def test_normal_variates_follow_the_normal_law():
    sample = np.empty(1_000_000)
    fill_normal(seed_stream(1, 0), sample)
    assert kstest(sample, "norm").pvalue > 1e-3
    moments = [np.mean(sample**k) for k in (1, 2, 3, 4, 6)]
    spread = np.array([1, 2, 15, 96, 10170]) ** 0.5 / np.sqrt(len(sample))
    assert np.all(np.abs(np.array(moments) - [0, 1, 0, 3, 15]) < 5 * spread)


def test_the_ziggurats_tail_beyond_its_last_layer_is_exact():
    sample = np.empty(4_000_000)
    fill_normal(seed_stream(3, 0), sample)
    edge = 3.6541528853610088
    tail = np.abs(sample[np.abs(sample) > edge])
    expected = 2 * norm.sf(edge) * len(sample)
    assert abs(len(tail) - expected) < 5 * np.sqrt(expected)
    assert kstest(norm.sf(tail) / norm.sf(edge), "uniform").pvalue > 1e-3


def test_each_layer_is_hit_in_proportion_to_its_share_of_the_law():
    sample = np.empty(2_000_000)
    fill_normal(seed_stream(5, 0), sample)
    edges = norm.ppf(np.linspace(0, 1, 513))
    counts = np.histogram(sample, edges)[0]
    chi2 = np.sum((counts - len(sample) / 512) ** 2) / (len(sample) / 512)
    assert abs(chi2 - 511) < 5 * np.sqrt(2 * 511)


def test_uniform_variates_fill_the_open_interval():
    sample = np.empty(1_000_000)
    fill_uniform(seed_stream(1, 0), sample)
    assert kstest(sample, "uniform", (-1, 2)).pvalue > 1e-3
    stream = seed_stream(1, 0)
    assert all(0.0 < uniform(stream) <= 1.0 for _ in range(1000))


@pytest.mark.parametrize("lag", [1, 2, 5])
def test_signs_are_fair_and_uncorrelated(lag):
    sample = np.empty(640_000)
    fill_sign(seed_stream(9, 0), sample)
    assert set(sample) == {-1.0, 1.0}
    assert abs(sample.mean()) < 5 / np.sqrt(len(sample))
    assert abs(np.mean(sample[lag:] * sample[:-lag])) < 5 / np.sqrt(len(sample))
