"""What the values of options can be, and what is said of others."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest

from daqsvc import cli
from daqsvc.cli import main
from daqsvc.commands.arguments import channel_map, sampling_rate_hz


def test_channel_map():
    assert channel_map("x=x_disc") == {"x": "x_disc"}
    assert channel_map(" x = bearing.gs ,y=data[1]") == {"x": "bearing.gs", "y": "data[1]"}
    assert channel_map("x=a=b") == {"x": "a=b"}


@pytest.mark.parametrize("text", ["", "x", "x=", "=a", "x=a,", "x=a,,y=b"])
def test_what_is_no_map(text):
    with pytest.raises(argparse.ArgumentTypeError, match="is not a map; write NAME=VARIABLE"):
        channel_map(text)


def test_a_map_names_each_channel_once():
    with pytest.raises(argparse.ArgumentTypeError, match="names 'x' twice; give each channel its own name"):
        channel_map("x=a,y=b, x=c")


@pytest.mark.parametrize("text", ["", "fast", "0", "0.5", "-100", "nan", "inf", "2e7"])
def test_what_is_no_sampling_rate(text):
    with pytest.raises(argparse.ArgumentTypeError, match="not a sampling rate from 1 to 10,000,000 Hz"):
        sampling_rate_hz(text)


def test_sampling_rate():
    assert sampling_rate_hz("25.6e3") == 25_600


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["run", ""], "FILE"),
        (["run", "m.toml", "--store", ""], "--store"),
        (["run", "m.toml", "-v", ""], "FILE"),
        (["check", "m.toml", ""], "FILE"),
        (["status", ""], "FILE"),
        (["alarms", "--store="], "--store"),
        (["ack", "hot", "--by", "me", ""], "FILE"),
        (["trend", "hot", "--store", ""], "--store"),
        (["reload", ""], "FILE"),
        (["record", "", "--out", "x"], "FILE"),
        (["example", "laval-rig", "--out", ""], "--out"),
    ],
)
def test_an_empty_path_is_not_the_working_directory(words, named, capsys):
    """A variable of a script that is not set would put the journal there."""
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert f"argument {named}: must not be empty; see daqsvc" in capsys.readouterr().err


@pytest.mark.parametrize(("verb", "kind"), [("run", Path), ("analyze", str)])
def test_files_after_an_option_are_as_those_before(verb, kind):
    option = {"run": "-v", "analyze": "--json"}[verb]
    chosen = cli._chosen(cli.parser(cli.commands()), [verb, "a.toml", option, "b.toml"])
    assert chosen.files == [kind("a.toml"), kind("b.toml")]
