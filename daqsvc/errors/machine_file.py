"""The machine file.

Errors of the file as a whole, of its keys, and of sensors. Those of buses, detectors, alarms and outputs are
in separate groups.
"""

from daqsvc.errors.code import Code

_PAGE = "machine-file.md"

UNREADABLE_FILE = Code(
    "F01",
    "The file cannot be read",
    "There is no such file, it is a directory or a device, or this user may not read it.",
    "Correct the path, or give the user of the service the right to read the file: chmod a+r FILE.",
    _PAGE,
    example="machine.toml: there is no such file. Remedy: correct the path, or begin with an example: daqsvc "
    "example",
)
NOT_UTF8 = Code(
    "F02",
    "The file is not UTF-8",
    "A machine file is text in UTF-8. Some editors, mostly on Windows, save in UTF-16 or in an older code"
    " page.",
    'Save the file as "UTF-8" in the editor.',
    _PAGE,
    example="machine.toml:17: is not UTF-8: byte 0xf6 at column 9. Remedy: save machine.toml as UTF-8",
)
NOT_TOML = Code(
    "F03",
    "The file is not valid TOML",
    "The text breaks the rules of TOML at the line that is named. Usually a quote or a bracket is not "
    "closed, or a text has no quotes. Or a key is there twice, or a number has a decimal comma or a "
    "unit.",
    'Correct the line. Tables are written [name], values key = value, texts "in quotes", numbers 1.5.',
    _PAGE,
    example="machine.toml:18: is not valid TOML: Unclosed array, at column 1. Remedy: close the bracket of "
    "line 17",
)
TOO_LARGE = Code(
    "F04",
    "The file is larger than a machine file can be",
    "Size, depth, numbers and entries have limits far above what a machine needs. Usually the wrong file "
    "was given.",
    "Check whether it is the right file. Watch a large plant with several machine files.",
    _PAGE,
    example="machine.toml:17: has a number with hundreds of digits. Remedy: write a number",
)
UNKNOWN_KEY = Code(
    "F05",
    "The key is unknown",
    "No table takes unknown keys, since a misspelt limit would have no effect. The key is misspelt, "
    "is in the wrong table, or belongs to another kind of this table.",
    "Write the key that the message suggests, move the key to its table, or remove it.",
    _PAGE,
    example="machine.toml:38: streams.drive-end.layout.channels[0].register = 17: unknown key. Remedy: did "
    "you mean address?",
)
MISSING_KEY = Code(
    "F06",
    "A key is missing",
    "The table cannot be understood without this key, and no default would be right for every machine.",
    "Add the key. The message has an example.",
    _PAGE,
    example="machine.toml:36: buses.can0.record.folder: is missing: folder of the files, relative to the "
    'machine file; it must exist. Remedy: add folder = "/var/lib/daqsvc/can" to [buses.can0.record]',
)
WRONG_TYPE = Code(
    "F07",
    "The value is of another type",
    "The key takes a number, a text, true or false, an array or a table, and the value is something else."
    " Often quotes are missing, or there are too many of them.",
    'Write numbers, true and false without quotes, texts "in quotes", arrays [in, brackets].',
    _PAGE,
    example='machine.toml:107: pipeline.rotor_bank.modes[2].unbalance_ratio = "1.8": must be a number. '
    "Remedy: take the quotes away: unbalance_ratio = 1.8",
)
OUT_OF_RANGE = Code(
    "F08",
    "The value is out of range",
    "Every number has bounds: beyond them no machine, sensor or device works. Usually the value has "
    "another unit than the name of the key has (_s seconds, _hz hertz, _um micrometres, _rpm revolutions"
    " a minute).",
    "Write the value in the unit that the name of the key ends with.",
    _PAGE,
    example="machine.toml:66: pipeline.bearing.calibrate_s = 3.0: must be 10 or more. Remedy: write "
    "calibrate_s = 30.0 (first seconds, which are the healthy state; kept over restarts)",
)
NOT_ONE_OF = Code(
    "F09",
    "The value is none of those that there are",
    "The key takes one of a few words or numbers, which the message lists.",
    "Write one of them as it is listed, in lower case.",
    _PAGE,
    example='machine.toml:48: streams.shaft.layout.byte_order = "middle": must be "little" or "big". Remedy: '
    'write one of these, e.g. byte_order = "little"',
)
BAD_NAME = Code(
    "F10",
    "The name has characters that no name can have",
    "Names become parts of topics of MQTT, in names of files and in log lines. So they have letters, digits, "
    "'_', '.' and '-' only.",
    "Write the name without spaces, umlauts and other signs. A description may have them.",
    _PAGE,
    example="machine.toml:14: site = \"...\": may only have letters, digits, '_', '.' and '-', and must not "
    "be empty; dots alone are no name. Remedy: give it a name",
)
BAD_TEXT = Code(
    "F11",
    "The text has not the form that this key takes",
    "The text is empty or too long, has line ends or control characters, or is not written as the key "
    "needs it.",
    "Write it as in the example of the message.",
    _PAGE,
    example='machine.toml:62: sensors[0].unit = " mm/s": is no unit: it holds spaces at an end, or what '
    'cannot be printed. Remedy: write e.g. unit = "degC"',
)
WRONG_LENGTH = Code(
    "F12",
    "The array has too few or too many entries",
    "Pairs such as ranges have exactly two values. Lists have an upper limit, and some must not be empty.",
    "Write as many values as the message asks for.",
    _PAGE,
    example="machine.toml:67: sensors[0].gap_ok_v = [-18.0, -2.0, 0]: must have 2 values. Remedy: write "
    "gap_ok_v = [-18.0, -2.0] (OK limits of the mean gap voltage, in V; needed where that is known)",
)
BAD_PATH = Code(
    "F13",
    "The path cannot be used",
    "The path is too long, has a variable of the shell, which is not put in here, or does not begin at "
    "the root where it must.",
    "Write the path in full. A relative path starts at the directory of the machine file.",
    _PAGE,
    example='machine.toml:45: buses.casing.port = "ttyUSB0": is not the whole path of a port. Remedy: write '
    "it from the root, e.g. /dev/serial/by-id/... or /dev/ttyUSB0",
)
BAD_ADDRESS = Code(
    "F14",
    "The address cannot be used",
    "It is no name or address of a host, or no URL of a broker. Often a port is in the host, or a "
    "scheme such as http:// before it.",
    "Write it as in the example of the message, and the port in its own key where there is one.",
    _PAGE,
    example='machine.toml:140: mqtt.url = "mqtts://broker/topic": has something after host and port. Remedy: '
    "end the url after the port",
)
WRONG_ORDER = Code(
    "F15",
    "The two ends of a range are in the wrong order",
    "A range is written with its lower end first, and its ends must differ.",
    "Swap the two values, or make them differ.",
    _PAGE,
    example="machine.toml:67: sensors[0].gap_ok_v = [-2.0, -18.0]: the lower limit must come first. Remedy: "
    "write [-18.0, -2.0]",
)
SECRET_IN_FILE = Code(
    "F16",
    "A password is in the machine file",
    "A machine file is read by many, copied and sent to others. So it names a file that holds the password.",
    "Write the password into a file that only the service can read, name it in password_file, and change "
    "the password: it has been in a file that others can read.",
    "mqtt.md",
    example='machine.toml:142: mqtt.password = "***": does not belong into a machine file. Remedy: write it '
    "into a file that only the service can read and name that in password_file",
)
NO_SUCH_NAME = Code(
    "F17",
    "There is nothing of that name",
    "A key refers to a bus, stream, channel, sensor, detector or signal by its name, and there is none. "
    "Usually the name is misspelt here or where it is defined.",
    "Write one of the names that the message lists, or define what is missing.",
    _PAGE,
    example='machine.toml:141: alarm_handling.start_up.measure = "sped": is nothing that rotor-bank states '
    'while the machine starts up. Remedy: did you mean "speed"? There are: speed',
)
NAMED_TWICE = Code(
    "F18",
    "A name, or what it names, is used twice",
    "Two entries have one name, one entry is listed twice, or two claim the same channel or device.",
    "Give each its own name or channel.",
    _PAGE,
    example='machine.toml:43: buses.can1.channel = "can0": belongs to bus "can0" already. Remedy: put all '
    "streams of the interface on one bus, or correct the channel",
)
NO_EFFECT = Code(
    "F19",
    "The key has no effect",
    "Nothing uses the key in this file, because of the other keys of its table or because what it is for "
    "is missing.",
    "Remove the key, or add what the message names.",
    _PAGE,
    example='machine.toml:34: streams.shaft.layout.stream_id = 1: has no effect: bus "probes" carries no '
    "stream ids. Remedy: write stream_ids = true in [buses.probes], or remove it",
)
CONTRADICTION = Code(
    "F20",
    "Two keys contradict each other",
    "Both keys state the same in different ways, or exclude each other, and only one can be right.",
    "Remove or correct one of the two.",
    _PAGE,
    example="machine.toml:37: buses.can0.data_bitrate = 250_000: is less than bitrate = 500,000, and the "
    "data of CAN FD never go slower. Remedy: swap the two, or correct one of them",
)
INCOMPLETE = Code(
    "F21",
    "The key needs another key",
    "The table has only a part of what is needed: this key is of no use without the one that the message"
    " names.",
    "Add the other key, or remove this one.",
    _PAGE,
    example="machine.toml:66: sensors[0].zero_v = -10.0: has no effect without sensitivity_mv_per_unit. "
    "Remedy: add sensitivity_mv_per_unit, or remove zero_v if the channel carries the physical unit",
)
NO_SUCH_DRIVER = Code(
    "F22",
    "The driver is not installed",
    "No installed package has a driver of this name.",
    "Correct the name. A driver from outside comes with its package: install that into the environment of"
    " daqsvc.",
    "write-a-driver.md",
    example='machine.toml:9: buses.can0.driver = "profibus": no such driver is installed. Remedy: take one '
    "of: can, modbus, replay, serial; or install the package that brings it",
)
PLUGIN_FAILED = Code(
    "F23",
    "A plugin failed",
    "A driver, detector or output cannot be loaded, or its code failed. The message names the file and "
    "the line.",
    "Install the package again. If that does not help, report it to the authors of the package, and "
    "remove its table until then.",
    "architecture.md",
    example="output mqtt.live is left out: [mqtt.live] is a table of daqsvc itself; rename it",
)
TOO_MUCH_MEMORY = Code(
    "F24",
    "The samples do not fit the memory",
    "The rings of all streams are larger than half of the memory of this computer. Their size is rate_hz "
    "times channels times ring_s.",
    "Write a smaller ring_s in [pipeline], or correct rate_hz.",
    _PAGE,
    example="machine.toml:48: pipeline.ring_s = 3600.0: the rings of 3600 s would take 144 GB, most of it "
    'for stream "drive-end" at 1e+07 Hz, and this computer has 8.2 GB. Remedy: write ring_s = 205.0 '
    "or less in [pipeline], or correct rate_hz of the stream",
)
VALUE_REFUSED = Code(
    "F25",
    "The value is refused",
    "The model of this table refuses the value; the message gives the reason.",
    "Do what the message asks for. A table of a plugin from outside is described by its package.",
    _PAGE,
    example='machine.toml:12: buses.logger.host = "127.0.0.1": is not valid: 127.0.0.1 is no address. '
    'Remedy: write host = "192.0.2.10" (name or address of the logger)',
)
NO_MACHINE_FILE = Code(
    "F26",
    "No machine file is in the directory",
    "A directory means all *.toml files in it that do not begin with a dot.",
    "Write a machine file there. daqsvc example shows some to begin with.",
    "several-machines.md",
    example="/etc/daqsvc/pumps: no machine file (*.toml) is in this directory. Remedy: copy an example into "
    "it: daqsvc example",
)
NOT_OF_ONE_BOX = Code(
    "F27",
    "The machine files do not fit each other",
    "One process watches all machines of a box. So site, box, buses of one name, the store and outputs "
    "must be alike, and each machine needs its own name.",
    "Make the tables alike, or write them in one of the files only.",
    "several-machines.md",
    example='machine.toml:13: box = "edge-3": but pump.toml has "edge-1", and one process is one box. '
    'Remedy: write box = "edge-1", or run it by itself',
)
UNUSED_BUS = Code(
    "F28",
    "No stream comes over the bus",
    "The bus is opened, and nothing is read from it.",
    "Add its streams, or remove the bus.",
    "driver-contract.md",
    example="machine.toml:32: buses.sync: no stream comes over this bus. Remedy: remove it, or add its "
    "streams",
)
SPEED_UNKNOWN = Code(
    "F29",
    "Nothing states the speed of the machine",
    "A key asks for the speed while the machine runs, and neither a detector nor a trend value states it.",
    "Add a detector that states the speed, or a sensor of type trend in rpm; or remove the key.",
    _PAGE,
    example='machine.toml:76: alarm_handling.start_up.detector = "levels/accel-de": no detector of this '
    "machine states a speed. Remedy: write a table [pipeline.rotor_bank] or "
    "[pipeline.rotor_synchronous], take a trend value that is the speed, or remove "
    "[alarm_handling.start_up] and every trip_multiply",
)
SNAPSHOTS_OVERLAP = Code(
    "F30",
    "Snapshots by the clock overlap",
    "every_s is shorter than before_s and after_s together: each snapshot would begin within the one before.",
    "Write a larger every_s, or continuous = true if all is to be recorded.",
    "recorder.md",
    example="machine.toml:151: recorder.every_s = 15.0: asks for a snapshot every 15 s, and each holds 20 s "
    "(before_s and after_s): they would overlap. Remedy: write every_s = 20 or more, or have all "
    "recorded with continuous = true",
)
COARSE_ALIGNMENT = Code(
    "F31",
    "Streams are aligned too coarsely for the speed",
    "The error that max_error_us allows is a large angle at this speed. A detector takes it for a change "
    "of the phase.",
    "Write a smaller max_error_us, or take the sensors together in one stream.",
    "alignment.md",
    example="machine.toml:106: pipeline.alignment.max_error_us = 2000.0: 2000 us are 18 deg of a revolution "
    "at 1500 rpm: as much as a fault moves the phase. Remedy: write max_error_us = 1110 or less, or "
    "bring the sensors together in one stream",
)
WRONG_SENSOR_TYPE = Code(
    "F32",
    "The sensor is of another type",
    "The key takes sensors of one type only, e.g. accelerometers, proximity probes or a keyphasor.",
    "Name a sensor of that type, or correct the type of the sensor.",
    _PAGE,
    example='machine.toml:111: alarms[0].sensor = "keyphasor": is a keyphasor, which measures no vibration. '
    "Remedy: take one of: probe-x, probe-y",
)
SAMPLED_APART = Code(
    "F33",
    "Sensors that belong together come in different streams",
    "What is compared sample by sample must be taken at the same instants. Each stream has its own clock.",
    "Name sensors of one stream, or write [pipeline.alignment] where the message names it.",
    "alignment.md",
    example='machine.toml:117: pipeline.rotor_bank.probes[0] = "probe-x": is in stream "shaft", but '
    'keyphasor "keyphasor" is in stream "other". Remedy: take sensors of one stream, or write a '
    "table [pipeline.alignment]: it puts samples that are not taken at the same instants on one grid",
)
SAMPLED_TOO_SLOWLY = Code(
    "F34",
    "The sampling rate is too low",
    "Samples show nothing above half of their rate, and pulses or orders of the shaft need several "
    "samples each revolution.",
    "Sample faster, or take a level that the device computes as a trend value. Or correct rate_hz, "
    "machine.speed_rpm or the frequencies that are asked for.",
    _PAGE,
    example='machine.toml:72: pipeline.bearing.bearings[0].sensor = "accel-de": is sampled at 2000 Hz: a '
    "bearing rings above 400 Hz. Remedy: sample at 2500 Hz or faster",
)
RING_TOO_SHORT = Code(
    "F35",
    "The ring does not hold enough windows",
    "A detector reads its windows from the ring of the last seconds, which must hold several of them.",
    "Write a larger ring_s in [pipeline], or a shorter window.",
    _PAGE,
    example="machine.toml:95: pipeline.levels.window_s = 20: a ring of 30 s must hold at least 2 windows. "
    "Remedy: write ring_s = 40 or more in [pipeline], or a shorter window",
)
UNLIKELY_SENSITIVITY = Code(
    "F36",
    "The sensitivity is not that of such a sensor",
    "Usually it was written in V in place of mV, or for another unit (m/s2 for g, mm for um).",
    "Copy it from the calibration sheet, in mV per unit of the sensor.",
    _PAGE,
    example="machine.toml:65: sensors[0].sensitivity_mv_per_unit = 7870.0: 7870 mV/um is what no sensor has; "
    "usual is some 7.87. Remedy: 7870 mV/mm are sensitivity_mv_per_unit = 7.87",
)
GAP_VOLTAGE = Code(
    "F37",
    "The gap voltage of a proximity probe is missing or does not fit",
    "The mean voltage tells where the shaft is and whether the probe works. It needs zero_v, gap_ok_v and"
    " sensitivity_mv_per_unit, all in the range that the probe gives, usually negative.",
    "Write them as in the manual of the probe, with their signs.",
    _PAGE,
    example="machine.toml:59: sensors[0].gap_ok_v: is missing: OK limits of the mean gap voltage, in V. "
    'Remedy: add gap_ok_v = [-18.0, -2.0] to the entry "probe-x" of sensors, as its manual has it',
)
PROBES_IN_LINE = Code(
    "F38",
    "Two probes point along one line",
    "Together they see one direction of the motion only. An orbit needs two directions.",
    "Correct angle_deg of the sensors, or take probes that are some 90 degrees apart.",
    _PAGE,
    example='machine.toml:98: pipeline.rotor_bank.probes = ["probe-x", "probe-y"]: the probes point along '
    "one line (0 and 180 deg): they see one direction of the motion only. Remedy: correct angle_deg "
    "of the sensors, or take probes that are some 90 deg apart",
)
BEYOND_CHANNEL = Code(
    "F39",
    "The channel cannot carry such a value",
    "By its type, scale and offset, and by the sensitivity of its sensor, the channel never has the value"
    " that is written.",
    "Correct the value, or scale, offset and sensitivity.",
    _PAGE,
    example="machine.toml:87: sensors[2].threshold_v = -60.0: is never crossed: the channel carries -32.768 "
    "to 32.767 V. Remedy: correct it, or the scale of the channel",
)
WRONG_SCALE = Code(
    "F40",
    "Scale or unit of a channel cannot be right",
    "The scale is 0, makes one count a value that no channel has, or contradicts the unit that is stated,"
    " e.g. mV for V.",
    "Write in scale what one count of the raw value is worth, in the unit of the channel.",
    "can.md",
    example="machine.toml:54: streams.shaft.layout.channels[0].scale = 0: would make every sample the same. "
    "Remedy: write what one count of the raw value is worth, e.g. 0.0005",
)
ROTOR_FIGURES = Code(
    "F41",
    "Figures of the rotor contradict each other",
    "By the figures of [machine.rotor] the shaft would lie on the stator, rub all the time, or run far "
    "from its natural frequency. Usually one has another unit, or the clearance is not the radial one.",
    "Correct the figure that the message names.",
    "rotor-figures.md",
    example="machine.toml:28: machine.rotor.static_sag_um = 130.0: lays the shaft on the stator: it would "
    "rest 130 um from the middle of a clearance of 100 um. Remedy: correct the sag, or the clearance "
    "(it is the radial one)",
)
STANDSTILL = Code(
    "F42",
    "The nominal speed is 0",
    "machine.speed_rpm is the speed at which the machine runs. A machine that stands still has no vibration.",
    "Write the nominal speed, negative if the shaft turns clockwise.",
    _PAGE,
    example="machine.toml:20: machine.speed_rpm = 0.0: is a shaft that stands still. Remedy: write the "
    "nominal speed, negative if the shaft turns clockwise",
)
OF_A_PLUGIN = Code(
    "F43",
    "A plugin reports something that has no code of its own",
    "The message is one of a driver, a detector or an output of another package. Its authors have given it "
    "no code.",
    "Do what the message asks for, and see the documentation of the package. Its authors can add codes: see "
    "write-a-driver.md.",
    "write-a-driver.md",
    example="machine.toml:14: buses.logger: is named by several streams. Remedy: name another bus in the "
    "others",
)
UNIT_UNKNOWN = Code(
    "F44",
    "A unit is not known",
    "The unit of a value is made of no symbol that units have, so it may be the answer to another question.",
    "Write the unit that the values have; or leave it if it is meant. It is shown beside values and limits.",
    "machine-file.md",
    example='machine.toml:78: sensors[2].unit = "float32": is not known as a unit. Remedy: write the unit of '
    "its values, e.g. mm/s, degC, kW or 1; or leave it if it is one",
)
THOUSANDS = Code(
    "F45",
    "A speed is so low that its point may be one between thousands",
    "1.485 is one revolution and a half a minute. In German and in other languages 1.485 is 1485, but the "
    "point is a decimal point in machine files.",
    "Write the speed in rpm without a point between thousands; or leave it if the shaft turns so slowly.",
    "machine-file.md",
    example="machine.toml:20: machine.speed_rpm = 1.485: is slow for a shaft, and the point is a decimal "
    "point. Remedy: write speed_rpm = 1485.0 if that is meant; or leave it",
)
