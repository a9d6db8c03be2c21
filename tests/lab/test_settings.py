"""Fields of a dataclass from text."""

from dataclasses import dataclass

import pytest

from idam.errors import InputError
from idam.lab.settings import with_settings
from idam.network.config import Config


@dataclass(frozen=True)
class Kettle:
    litres: float = 1.5
    cups: int = 4
    hot: bool = False
    colour: str = "blue"
    marks: tuple[float, ...] = (0.5,)


SET = {
    "litres=2": Kettle(litres=2.0),
    "cups=7": Kettle(cups=7),
    "hot=true": Kettle(hot=True),
    "hot=False": Kettle(),
    "colour=dark=green": Kettle(colour="dark=green"),
    "marks=": Kettle(marks=()),
    "marks=1,0.25": Kettle(marks=(1.0, 0.25)),
}


@pytest.mark.parametrize(("setting", "expected"), SET.items())
def test_text_becomes_the_field_s_own_type(setting, expected):
    assert with_settings(Kettle(), [setting]) == expected


def test_the_last_of_several_settings_counts_and_the_rest_stays():
    start = Kettle(colour="red")
    assert with_settings(start, ["cups=1", "cups=2", "hot=true"]) == Kettle(cups=2, hot=True, colour="red")
    assert start == Kettle(colour="red")


@pytest.mark.parametrize("setting", ["cup=1", "cups", "", "=3"])
def test_a_name_that_is_no_field_is_answered_with_the_fields(setting):
    with pytest.raises(InputError, match="litres, cups, hot, colour, marks") as caught:
        with_settings(Kettle(), [setting])
    assert repr(setting) in str(caught.value)


@pytest.mark.parametrize("setting", ["cups=1.5", "cups=", "litres=much", "hot=1", "marks=1;2"])
def test_a_value_of_another_type_is_refused_in_one_line(setting):
    with pytest.raises(InputError, match="is no value") as caught:
        with_settings(Kettle(), [setting])
    assert "\n" not in str(caught.value)


def test_every_field_of_the_network_can_be_set():
    texts = ["features=fpfh", "iterations=20", "keep=0.5", "keep_again=0.5,1", "soft_matches=true", "trusted=0.8"]
    expected = Config("fpfh", iterations=20, keep=0.5, keep_again=(0.5, 1.0), soft_matches=True, trusted=0.8)
    assert with_settings(Config(), texts) == expected
