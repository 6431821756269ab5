"""What ``daqsvc new`` asks about, in words: the questions at the terminal, and the help of its options."""

from __future__ import annotations

from daqsvc.commands.new.buses import buses
from drivers.bus_questions import SHARED
from drivers.questions import Topic

_TOPICS_BEFORE = {
    "bus": Topic(
        "What do the samples come over?",
        "Take virtual to try daqsvc without hardware: daqsvc sim then plays a machine.",
    ),
    "name": Topic(
        "What is the machine called?",
        "Any words. Topics and files get a short name that is made of them: Pump 3 becomes pump-3.",
    ),
    "site": Topic("Name of the site", "It is part of every topic and message."),
    "box": Topic("Name of this computer in topics", "It is part of every topic and message."),
    "seconds": Topic(
        "How long does --listen listen, in s?",
        "auto: some seconds, and longer if too little comes to judge. A device that sends once a second or "
        "less needs e.g. 20. Of Modbus registers: how long they are read again and again.",
    ),
}
"""Before what is asked about the bus."""

_TOPICS_BEHIND = {
    "speed": Topic(
        "Speed of the shaft, in rpm",
        "The usual one, from the nameplate; negative if the shaft turns clockwise. A "
        "keyphasor measures it as well.",
    ),
    "rate": Topic(
        "Samples a second of each channel", "The sampling rate in Hz. For values that are read: how often."
    ),
    "limits": Topic(
        "Which alarm limits?",
        "iso: zones C and D of ISO 20816-3. own: two figures of yours. none: write them into the file later.",
    ),
    "class": Topic(
        "Which class of machine is it?",
        "2-rigid or 2-flexible: 15 to 300 kW; 1-rigid or 1-flexible: above. By ISO 20816-3 a support is "
        "flexible if the machine's lowest frequency on it lies below its speed.",
    ),
    "alert": Topic("Alert limit", "From here on somebody should look at the machine."),
    "danger": Topic("Danger limit", "From here on the machine takes damage."),
    "broker": Topic(
        "Address of an MQTT broker",
        "mqtts://HOST:8883, or mqtt://HOST:1883 without encryption; none: alarms are shown at this box only.",
    ),
    "username": Topic("User name at the broker", "none if the broker asks for none."),
    "password-file": Topic(
        "File whose first line is the password", "The password itself is in no machine file."
    ),
    "home-assistant": Topic("Show the machine in Home Assistant?", "By its MQTT discovery."),
}
"""Behind it."""

TOPICS = {**_TOPICS_BEFORE, **_TOPICS_BEHIND}
"""Whatever the bus is."""

_TYPE_HELP = (
    "Many samples a second: proximity (the shaft, in um or mil), accelerometer (the housing, in g, "
    "m/s2, mg or mm/s2), velocity (the housing, in mm/s). One value some times a second or less, which the "
    "device has computed, such as a velocity RMS or a temperature: trend. none leaves the channel out."
)
SENSOR_TOPICS = {
    "type": Topic("What is on channel {channel}?", _TYPE_HELP),
    "name": Topic("Name of that sensor", "Best its place, e.g. de-horizontal: drive end, horizontal."),
    "unit": Topic("Unit of {channel}", "The unit in which limits are given and values are shown."),
    "sensitivity": Topic(
        "Sensitivity of {channel}, in mV per {unit}",
        "From the sensor's calibration sheet. none if the samples are in {unit} already.",
    ),
    "angle": Topic(
        "Where does {channel} point, in degrees?",
        "0 to the right (+x), 90 upwards, counted anticlockwise; seen from the driving end.",
    ),
    "threshold": Topic("Level that a pulse of {channel} crosses, in V", "Half-way up the pulse."),
    "bearing": Topic(
        "Rolling bearing under {channel}",
        "Its designation, e.g. 6205-2RS; or balls, ball and pitch diameter in mm: 9, 7.94, 39.04; or none.",
    ),
}
"""Of one channel each; ``{channel}`` and ``{unit}`` are filled in."""


def all_topics() -> dict[str, Topic]:
    """All that can be asked, but of one channel, by key and in the order of the interview."""
    of_buses: dict[str, Topic] = {}
    for bus in buses().values():
        of_buses |= {key: topic for key, topic in bus.topics.items() if key not in of_buses}
    return {**_TOPICS_BEFORE, **SHARED, **of_buses, **_TOPICS_BEHIND}
