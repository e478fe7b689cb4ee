"""docs/promises.md: every promise names tests that exist, and what it says of the code's defaults is so."""

import ast
import inspect
import re
from pathlib import Path

import pytest

from sb3_ctco import CTCO
from sb3_ctco.common.policies import LOG_STD_MAX, LOG_STD_MIN

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "docs" / "promises.md").read_text(encoding="utf-8")


def test_every_promise_has_tests_that_exist():
    named = re.findall(r"`(tests/\w+\.py)::(\w+)`", TEXT)
    assert len(named) > 60
    missing = []
    for file, test in named:
        functions = {node.name for node in ast.parse((ROOT / file).read_text(encoding="utf-8")).body if hasattr(node, "name")}
        if test not in functions:
            missing.append(f"{file}::{test}")
    assert not missing
    promises = TEXT[: TEXT.index("## What is not promised")]
    for row in re.findall(r"^\| (?!What happens|Promise|-)(.*) \|$", promises, re.MULTILINE):
        assert "tests/test_" in row, row


def test_deviations_are_those_of_the_code():
    defaults = {name: parameter.default for name, parameter in inspect.signature(CTCO.__init__).parameters.items()}
    set_by_paper_defaults = CTCO.paper_defaults()
    for name, value, phrase in [
        ("gradient_steps", -1, "one for each primitive step (`gradient_steps=-1`)"),
        ("ent_coef", "auto_0.02", "learned by dual ascent from 0.02"),
        ("learning_starts", 100, "`learning_starts=100` steps play random options"),
        ("learning_rate", 1e-3, "Adam, 1e-3"),
        ("d_max", None, "| a fifth of the horizon 1/τ, 0.5 s | `d_max` |"),
        ("tau", 0.01, "both targets with 0.01"),
        ("buffer_size", 1_000_000, "a buffer of 1,000,000"),
    ]:
        assert defaults[name] == value, name
        assert name not in set_by_paper_defaults
        assert phrase in TEXT
    assert set(set_by_paper_defaults) == {
        "n_sub_options",
        "n_rbf",
        "high_freq_penalty",
        "entropy_reference",
        "policy_kwargs",
        # What the class has, too, and must stay if its defaults change
        "trajectory",
        "duration_scale",
        "join",
        "d_min",
        "critic_pessimism",
        "batch_size",
    }
    assert defaults["high_freq_penalty"] == "relative_0.1"
    assert defaults["entropy_reference"] == "average"
    assert f"clamped to [−{-LOG_STD_MIN:.0f}, {LOG_STD_MAX:.0f}]" in TEXT


@pytest.mark.parametrize("kind", ["terminate_at", "truncate_at"])
def test_the_asked_duration_is_stored_where_an_episode_cuts_an_option_off(scripted_env, kind):
    env = scripted_env(**{kind: 4})  # steps of 0.1 s
    model = CTCO("MlpPolicy", env, n_rbf=1, d_min=0.7, d_max=0.7001, n_sub_options=0, learning_starts=100, buffer_size=10)
    model.learn(4)
    # Asked for 0.7 s, and 0.4 s ran.
    assert model.replay_buffer.durations[0, 0] == pytest.approx(0.4)
    wide = CTCO("MlpPolicy", env, n_rbf=1, d_max=20.0, n_sub_options=0, learning_starts=100, buffer_size=10, seed=1)
    wide.learn(4)
    asked = 0.1 + 0.5 * (wide.replay_buffer.actions[0, 0, -1] + 1.0) * 19.9
    assert asked > 0.5
    assert wide.replay_buffer.durations[0, 0] == pytest.approx(0.4)
