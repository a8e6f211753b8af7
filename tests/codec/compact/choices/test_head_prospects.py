"""Heads that are worth a training: their widths, and which of the two kinds can pay."""

from __future__ import annotations

from fhash_codec.compact.choices.head_prospects import (
    GAIN_BY_WIDTHS,
    PERCEPTRON,
    Shape,
    best_widths,
    expected_gain,
    likely_heads,
    most_saved,
)


def test_a_small_file_gets_no_head_and_a_large_one_a_large_head() -> None:
    def widths(size: float, gain: float = 0.5, effort: int = 9) -> tuple[int, int] | None:
        return best_widths(size, gain, 4.5, effort)

    assert widths(1_000) is None
    chosen = [widths(size) for size in (1e4, 2e4, 3e4, 1e5, 3e5, 1e6)]
    ranks = [list(GAIN_BY_WIDTHS).index(each) for each in chosen if each is not None]
    assert ranks == sorted(ranks)
    assert len(set(ranks)) > 2
    # Weights cost decoding time, whatever the size of the file: a small gain pays for few of them.
    assert widths(1e9, gain=3.0) == (14, 24)
    assert widths(1e9, gain=3.0, effort=5) == (12, 12)
    assert widths(1e6, gain=0.01) is None


def test_a_perceptron_that_cannot_pay_is_told_from_its_size_and_the_gain_of_the_trial() -> None:
    assert most_saved(20_000, 0.03, 4.5) < 0
    assert most_saved(20_000, 0.5, 4.5) > 0
    assert most_saved(500_000, 0.03, 4.5) > 0


def test_no_head_is_trained_that_the_other_one_is_sure_to_beat() -> None:
    def shapes(size: float, gain: float) -> list[Shape]:
        return likely_heads(size, gain, 4.5, effort=5)

    # Few weights pay where little is to be gained, many where much is.
    assert shapes(1_000, 0.5) == []
    assert shapes(120_000, 0.14) == [PERCEPTRON]
    assert [shape.cross for shape in shapes(1e6, 3.0)] == [True]
    assert [shape.cross for shape in shapes(60_000, 0.5)] == [True, False]


def test_a_full_training_is_expected_to_gain_more_than_the_trial() -> None:
    assert [expected_gain(gain) > gain for gain in (0.0, 0.1, 1.0)] == [True] * 3


def test_weights_and_products_of_a_head() -> None:
    assert Shape((12, 8), cross=False).weights == 28 * 12 + 12 * 8 + 8
    assert Shape((12, 8), cross=False).products == 28 * 12 + 12 * 8 + 8
    assert Shape((8, 8), cross=True).weights == 28 * 8 + 9 * 8 * 8 + 8
    assert Shape((8, 8), cross=True).products == 9 * (28 * 8 + 8 * 8) + 8
