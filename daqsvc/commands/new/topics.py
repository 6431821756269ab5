"""What ``daqsvc new`` asks about, in words: the questions at the terminal, and the help of its options."""

from __future__ import annotations

from daqsvc.commands.new.question import Topic

TOPICS = {
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
    "socket": Topic("Path of the virtual bus", "A socket file that daqsvc run and daqsvc sim share."),
    "interface": Topic(
        "Kind of CAN adapter",
        "socketcan for adapters that Linux shows as can0; or another interface of python-can, e.g. pcan.",
    ),
    "channel": Topic(
        "Which CAN interface?", "The name that `ip link` shows, e.g. can0; with other adapters their channel."
    ),
    "fd": Topic(
        "Are CAN FD frames on the bus?", "CAN FD frames carry up to 64 bytes. The device's manual says so."
    ),
    "bitrate": Topic(
        "Bit rate of the bus, in bit/s", "As all devices on it are set: often 250000 or 500000."
    ),
    "data-bitrate": Topic("Bit rate of the data of CAN FD frames, in bit/s", "As all devices are set."),
    "dbc": Topic(
        "Which DBC file describes the frames?", "The maker of the device has it. A path from this folder."
    ),
    "message": Topic(
        "Which message of it carries the samples?", "The frame that comes at the sampling rate."
    ),
    "signals": Topic(
        "Which of its signals are measured?",
        "Names with commas between; each becomes a channel. Leave out counters and states.",
    ),
    "counter": Topic(
        "Which signal or column counts the frames or lines, or tells the time?",
        "By it lost samples are found. none if there is no such signal (CAN only).",
    ),
    "counts": Topic(
        "What does it hold?", "count grows by one with each frame or line; s, ms and us are times."
    ),
    "id": Topic("CAN id of the frames", "Decimal, or hexadecimal with 0x. candump shows ids."),
    "channels": Topic(
        "What are the channels called?",
        "Names with commas between, in the order in which the device sends them.",
    ),
    "raw-type": Topic("Type of a sample in the frame", "The device's manual says so."),
    "scale": Topic(
        "What is one count of a sample worth?",
        "In volts if the device digitises a sensor, else in the unit of the sensor. See the device's manual.",
    ),
    "samples-per-frame": Topic("Samples of each channel in a frame", "The device's manual says so."),
    "host": Topic("Address of the Modbus device", "An IP address or a host name, without http://."),
    "tcp-port": Topic("TCP port of the Modbus device", "Nearly always 502."),
    "port": Topic(
        "Which serial port?",
        "Best the path below /dev/serial/by-id, which stays the same: ls -l /dev/serial/by-id shows it.",
    ),
    "baud": Topic("Baud rate, in bit/s", "As the device is set; its manual says so."),
    "parity": Topic("Parity of the line", "As the device is set: none, even or odd."),
    "unit": Topic("Address of the unit (slave id)", "1 to 247; set in the device, by switches or software."),
    "way": Topic(
        "What does the device give?",
        "values: it measures levels itself, e.g. velocity RMS. waveform: blocks of samples.",
    ),
    "table": Topic(
        "Which registers are they?",
        "Manuals call holding registers 40001 and on, input registers 30001 and on.",
    ),
    "block-id": Topic("Register that changes with every block", "As on the wire, from 0: 40001 is 0."),
    "block-address": Topic("First register of the block", "As on the wire, from 0: 40001 is 0."),
    "samples": Topic("Samples of each channel in a block", "The device's manual says so."),
    "columns": Topic(
        "What are the columns of a line, in order?",
        "Names with commas between; give those that nobody needs a name, too.",
    ),
    "separator": Topic("Character between columns", "A comma, semicolon, blank or tab."),
    "checksum": Topic("Checksum at the end of a line", "Behind a *: xor as in NMEA 0183, crc16, or none."),
    "prefix": Topic("Word that each line begins with", "e.g. $ACC; none if the first column is a number."),
    "speed": Topic(
        "Speed of the shaft, in rpm",
        "The usual one, from the nameplate; negative if the shaft turns clockwise. A keyphasor measures it "
        "besides.",
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
        "ISO 20816-3. A support is flexible if the machine's lowest frequency on it lies below its speed.",
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
    "home-assistant": Topic("Shall the machine show up in Home Assistant?", "By its MQTT discovery."),
}

SENSOR_TOPICS = {
    "address": Topic("Register of {channel}", "As on the wire, from 0: what a manual calls 40001 is 0."),
    "register-type": Topic("What do the registers of {channel} hold?", "The register map says so."),
    "order": Topic("Byte order of {channel}", "ABCD is the usual one; CDAB has its words exchanged."),
    "scale": Topic("What is one count of {channel} worth?", "In the unit of the value, e.g. 0.01 mm/s."),
    "type": Topic("What is on channel {channel}?", "none leaves the channel out."),
    "name": Topic("Name of that sensor", "Best its place, e.g. de-horizontal: drive end, horizontal."),
    "unit": Topic("Unit of {channel}", "The unit in which limits are given and values are shown."),
    "sensitivity": Topic(
        "Sensitivity of {channel}, in mV per {unit}",
        "From the sensor's calibration sheet. none if the samples are in {unit} already.",
    ),
    "angle": Topic(
        "Where does {channel} point, in degrees?",
        "0 to the right (+x), 90 upwards, counted against the clock; seen from the driving end.",
    ),
    "threshold": Topic("Level that a pulse of {channel} crosses, in V", "Half-way up the pulse."),
    "bearing": Topic(
        "Rolling bearing under {channel}",
        "Its designation, e.g. 6205-2RS; or balls, ball and pitch diameter in mm: 9, 7.94, 39.04; or none.",
    ),
}
"""Of one channel each; ``{channel}`` and ``{unit}`` are filled in."""
