from __future__ import annotations

from dataclasses import asdict

import pytest

from baselines.configs import PRESETS, TrainingConfig, changed_settings, learning_rate_at
from semantic2d_dataset.errors import InvalidInputError


def test_the_defaults_are_the_published_settings():
    config = TrainingConfig()
    assert config == PRESETS["paper"]()
    assert (config.learning_rate, config.weight_decay, config.batch_size) == (1e-4, 1e-3, 1024)
    assert config.betas == (1, 1, 0.01)
    assert config.class_weight_power == 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"features": "RX"}, "unknown features 'RX'"),
        ({"epochs": 0}, "epochs: expected above 0"),
        ({"batch_size": 0}, "batch_size: expected above 0"),
        ({"learning_rate": float("nan")}, "learning_rate: expected above 0"),
        ({"learning_rate": float("inf")}, "learning_rate: expected above 0"),
        ({"weight_decay": -1.0}, "weight_decay: expected 0 or more"),
        ({"class_weight_power": float("nan")}, "class_weight_power: expected 0 or more"),
        ({"betas": (1.0, -1.0, 0.0)}, "betas: expected 0 or more, found -1.0"),
        ({"seed": -1}, "seed: expected a whole number from 0 to 4294967295, found -1"),
        ({"seed": 2**32}, "seed: expected a whole number"),
        ({"time_limit_s": 0.0}, "time_limit_s: expected above 0"),
        ({"schedule": "step"}, "unknown schedule 'step'; known are constant and one-cycle"),
        ({"betas": (1.0, 1.0)}, "betas: expected 3 weights"),
    ],
)
def test_settings_that_cannot_be_used_are_refused(changes: dict, message: str):
    with pytest.raises(InvalidInputError, match=message):
        TrainingConfig(**changes)


def test_features_are_kept_in_the_order_of_their_channels():
    assert TrainingConfig(features="a+r").features == "RA"


def test_one_cycle_rises_to_the_learning_rate_and_ends_at_zero():
    config = TrainingConfig(schedule="one-cycle", learning_rate=0.01)
    rates = [learning_rate_at(config, i / 100) for i in range(101)]
    top = rates.index(max(rates))
    assert rates[top] == pytest.approx(0.01)
    assert rates[: top + 1] == sorted(rates[: top + 1])
    assert rates[top:] == sorted(rates[top:], reverse=True)
    assert rates[-1] == pytest.approx(0, abs=1e-12)


def test_a_constant_schedule_stays():
    config = TrainingConfig()
    assert {learning_rate_at(config, p) for p in (0.0, 0.5, 1.0)} == {1e-4}


def test_a_setting_that_an_earlier_run_did_not_know_had_its_default():
    before = asdict(TrainingConfig())
    del before["bf16"]
    assert changed_settings(asdict(TrainingConfig()), before) == []
    assert changed_settings(asdict(TrainingConfig(bf16=True, seed=1)), before) == ["seed", "bf16"]
