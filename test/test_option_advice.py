# SPDX-License-Identifier: Apache-2.0
"""Advice in the words of a command: its options, not the node's parameters and topics."""

from __future__ import annotations

import re

import pytest

from paul_ros.cli.launcher import build_parser
from paul_ros.errors import PaulError
from paul_ros.stream.option_advice import TOPICS, in_options
from paul_ros.stream.parameters import DEFAULTS, checked
from paul_ros.stream.reasons import REASONS

REPLAY = vars(build_parser(["replay"]).parse_args(["replay", "BAG"]))
LIFT = vars(build_parser(["lift"]).parse_args(["lift", "IN", "-o", "OUT"]))
OPTIONS = {f"--{name.replace('_', '-')}" for name in REPLAY}


@pytest.mark.parametrize(
    "advice, shown",
    [
        ("Set `layout` to yours.", "Set --layout to yours."),
        ("Raise the parameter `max_persons` above 64.", "Raise --max-persons above 64."),
        ("Remap `keypoints` to 2D keypoints.", "Set --topic to 2D keypoints."),
        ("Publish it, and remap `camera_info` to it.", "Publish it, and set --camera-info-topic to it."),
        ("check that `depth` is aligned", "check that the topic of --depth-topic is aligned"),
        ("`person_height` is 9.0; `model` is x", "--person-height is 9.0; --model is x"),
        ("run `paul train`, `plot`, `bag` or `input_type`", "run `paul train`, `plot`, `bag` or `input_type`"),
    ],
)
def test_parameters_and_topics_become_options(advice, shown):
    assert in_options(advice, REPLAY) == shown


def test_an_option_that_the_command_lacks_is_not_named():
    advice = "Lower `min_confidence`, raise `max_persons`, or remap `depth`."
    assert in_options(advice, LIFT) == "Lower --min-confidence, raise `max_persons`, or remap `depth`."


@pytest.mark.parametrize("slug", REASONS)
def test_replay_has_an_option_for_all_that_advice_names(slug):
    """No parameter or topic of the node is left, and no option is named that the command lacks."""
    shown = in_options(REASONS[slug].advice, REPLAY)
    assert not set(re.findall(r"`(\w+)`", shown)) & {*DEFAULTS, *TOPICS}
    assert set(re.findall(r"--[a-z-]+", shown)) <= OPTIONS and "paul:" not in REASONS[slug].advice


@pytest.mark.parametrize("name", ["person_height", "smoothing", "min_confidence", "max_persons"])
def test_a_value_out_of_range_is_named_by_its_option(name):
    with pytest.raises(PaulError) as error:
        checked({name: -1.0})
    assert in_options(str(error.value), REPLAY).startswith(f"--{name.replace('_', '-')} is -1.0; it must be ")
