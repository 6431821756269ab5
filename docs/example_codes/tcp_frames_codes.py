"""The codes of the messages about data loggers on TCP."""

from daqsvc.api import PluginCode

SEVERAL_STREAMS = PluginCode(
    "TCPF01",
    "A logger has several streams",
    "A logger sends one stream, without anything that would tell two of them apart.",
    "Name another bus in the other streams.",
    "https://example.com/tcp-frames",
)
