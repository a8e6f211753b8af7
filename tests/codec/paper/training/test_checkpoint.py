"""Checkpoints: stopping and going on changes nothing, and each belongs to one training."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.config import EncodeConfig
from fhash_codec.paper.training.checkpoint import checkpoint_path, load_checkpoint, save_checkpoint
from fhash_codec.paper.training.train import TrainingProgress, train
from fhash_formats.errors import InputError
from fhash_formats.support.interrupts import StopRequest


@pytest.mark.parametrize("moment", [1, 7, 20, 33])
def test_going_on_from_a_checkpoint_ends_at_the_same_bits(setup, coreset, tmp_path, moment) -> None:
    plan, whole = setup(coreset)
    train(whole, plan, coreset, TrainingProgress())

    _, engine = setup(coreset)
    stop, reached, path = StopRequest(), TrainingProgress(), tmp_path / "run.checkpoint"

    def ask(stage, done, total, note):
        stop.asked = done >= moment

    assert not train(
        engine,
        plan,
        coreset,
        reached,
        stop=stop,
        save=lambda c: save_checkpoint(path, engine.state(), c),
        progress=ask,
    )
    state, later = load_checkpoint(path)
    _, resumed = setup(coreset)
    resumed.restore(state)
    assert train(resumed, plan, coreset, later)
    for name, array in whole.state().items():
        np.testing.assert_array_equal(array, resumed.state()[name], err_msg=name)
    assert len(later.history) == 4


def test_a_checkpoint_belongs_to_its_coreset_and_settings(coreset, other_coreset, tmp_path) -> None:
    output = tmp_path / "run.fhz"
    one = checkpoint_path(output, coreset, EncodeConfig(profile="paper"))
    assert one.parent == tmp_path
    assert one == checkpoint_path(
        output, coreset, EncodeConfig(profile="paper", psnr=50.0, tables="float32", timings=False)
    )
    assert one == checkpoint_path(output, coreset, EncodeConfig(profile="paper", device="cpu"))
    other_bits = EncodeConfig(profile="paper", deterministic=True)
    assert one != checkpoint_path(output, coreset, other_bits)
    assert one != checkpoint_path(output, coreset, EncodeConfig(profile="paper", epochs=3))
    assert one != checkpoint_path(output, other_coreset, EncodeConfig(profile="paper"))


def test_a_damaged_checkpoint_is_named_not_ignored(tmp_path) -> None:
    path = tmp_path / "run.checkpoint"
    assert load_checkpoint(path) is None
    for damaged in (b"PK\x03\x04 and then nothing", b""):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"run\.checkpoint cannot be read"):
            load_checkpoint(path)


def test_tables_that_change_the_sizes_of_the_model_have_a_checkpoint_of_their_own(
    coreset, tmp_path
) -> None:
    def path(**settings):
        return checkpoint_path(tmp_path, coreset, EncodeConfig(profile="paper", **settings))

    published = {"fold": 2, "embedding_size": 2, "width": 64}
    assert path() == path(tables="uint8") == path(**published)
    assert path() == path(tables="transform", **published)
    for setting in published:
        assert path() != path(tables="transform", **(published | {setting: 0}))


def test_engines_that_go_on_from_each_other_share_a_checkpoint(coreset, tmp_path) -> None:
    def path(engine):
        return checkpoint_path(tmp_path, coreset, EncodeConfig(profile="paper", engine=engine))

    assert path("auto") == path("native") == path("slab")
