"""Buses, frames and drivers."""

from daqsvc.errors.code import Code

_PAGE = "can.md"

WRONG_LAYOUT = Code(
    "B01",
    "The layout does not belong to this bus",
    "A layout states where samples are in what the bus carries: CAN frames, registers, lines or binary "
    "frames. This one is for another kind of bus.",
    "Correct bus of the stream, or write the keys of a layout for this bus.",
    "driver-contract.md",
    example='machine.toml:32: streams.shaft.layout: is no layout of a line, and bus "casing" carries lines. '
    'Remedy: write line = ["seq", "x"], the names of the columns',
)
FIELD_OUTSIDE = Code(
    "B02",
    "A field reaches beyond the frame",
    "By place, type and number of samples a channel or counter would take bytes that the frame does not "
    "have.",
    "Correct the place or the number of samples, or make the frame longer, as the device sends it.",
    _PAGE,
    example="machine.toml:50: streams.shaft.layout.first_byte = 2: the samples would take bytes 2 to 67 of a "
    "frame of 64 bytes. Remedy: write samples_per_frame = 10, or make the frame longer",
)
FIELDS_OVERLAP = Code(
    "B03",
    "Two fields of a frame overlap",
    "Two channels, or a channel and the counter, would take the same bytes.",
    "Compare the places with the description of the device.",
    _PAGE,
    example="machine.toml:52: streams.shaft.layout.crc_byte = 60: the CRC (bytes 60 to 61) would overlap the "
    "samples (bytes 2 to 61). Remedy: move the CRC to byte 62 or behind, as the device sends it",
)
RAW_VALUES = Code(
    "B04",
    "valid_raw or no_value does not fit the type of the channel",
    "Both have raw values, before scale and offset. These cannot come in the type of the channel.",
    "valid_raw: write the least and the largest whole number that the device sends for a measurement. "
    "no_value: write those that it sends where it has none.",
    _PAGE,
    example="machine.toml:68: streams.shaft.layout.channels[0].valid_raw = [-40000, 32767]: does not lie "
    "within what int16 can carry, -32768 to 32767. Remedy: write the raw values as the device sends "
    "them, before scale and offset",
)
LOSS_UNNOTICED = Code(
    "B05",
    "Lost samples would not be noticed",
    "A counter in each frame or line tells what was lost and when a sample was taken. A time in each line"
    " does so less exactly. Without both, loss is estimated from the times of arrival, and daqsvc check "
    "warns of it where lines of text are read so.",
    "State where the counter is. If the device sends none, write no_counter = true into the layout: loss is "
    "then estimated. Binary frames of a serial port need a counter.",
    "driver-contract.md",
    example="machine.toml:54: streams.casing.layout: has neither counter nor time: lost lines would not be "
    'noticed. Remedy: add counter = { column = "seq" } or time = { column = "t", unit = "ms" }, '
    "whichever it sends; if it sends neither, no_counter = true",
)
UNFIT_COUNTER = Code(
    "B06",
    "The counter does not fit",
    "It wraps too soon to tell a gap from a turn, does not count by 1 from 0, or is signed or a float.",
    "Name another counter, have the device send a wider one, or write no_counter = true.",
    "driver-contract.md",
    example='machine.toml:15: streams.casing.layout.counter = { byte = 0, bits = 8, counts = "samples" }: a '
    "counter of 8 bits cannot tell frames of 64 samples apart: it wraps within four of them. Remedy: "
    'have the device send a wider counter, or count "frames"',
)
CAN_ID = Code(
    "B07",
    "No frame of this kind has such an id",
    "Ids of CAN have 11 bits, or 29 with extended = true. Ids of SAE J1939 have 29.",
    "Correct the id, or write extended = true.",
    _PAGE,
    example="machine.toml:46: streams.shaft.layout.id = 0x801: does not fit into 11 bits (0x7ff). Remedy: "
    "write extended = true if the device sends 29-bit ids, else correct the id",
)
FRAME_LENGTH = Code(
    "B08",
    "No frame has that length",
    "A frame of classic CAN has up to 8 bytes, one of CAN FD up to 64 in steps.",
    "Correct the length, or write fd = true in the table of the bus.",
    _PAGE,
    example="machine.toml:15: streams.casing.layout.length = 64: has 64 bytes: only CAN FD carries more than "
    '8, and bus "can0" is classic CAN. Remedy: write fd = true in [buses.can0], or make the frame 8 '
    "bytes or shorter",
)
NOT_TOLD_APART = Code(
    "B09",
    "Two streams cannot be told apart",
    "Streams on one bus differ by their id, prefix or stream_id, and these have the same.",
    "Give each stream its own, as the devices send it.",
    "driver-contract.md",
    example='machine.toml:65: streams.other.layout.id = 0x101: id 0x101 on bus "can0" belongs to stream '
    '"shaft" already. Remedy: give each stream of a bus its own id, as the devices send it',
)
BUS_TOO_SLOW = Code(
    "B10",
    "The bus is too slow for its streams, or nearly so",
    "Rates and lengths of all frames or requests together take most of the time of the bus, or more than "
    "that. What does not fit comes late or is lost.",
    "Correct rate_hz of the streams, raise the bit rate of bus and devices, or divide the streams among "
    "buses.",
    "driver-contract.md",
    example="machine.toml:23: buses.probes.baud = 115_200: is too slow: the streams on the port need 870,400 "
    "bit/s at least, 756 % of it. Remedy: correct the rates of the streams, or set port and device "
    "to a faster rate",
)
NO_SUCH_INTERFACE = Code(
    "B11",
    "The interface of CAN is not known",
    "python-can has no interface of this name, or the package that brings it is not installed. Or the "
    "channel is no name that Linux gives to a CAN interface.",
    "Correct the name, or install the plugin of python-can for the device.",
    _PAGE,
    example='machine.toml:33: buses.can0.interface = "socketcn": python-can knows no such interface. Remedy: '
    'did you mean "socketcan"? There are: canalystii, cantact, etas, gs_usb, iscan, ixxat, kvaser, '
    "neousys, neovi, nican, nixnet, pcan, robotell, seeedstudio, serial, slcan, socketcan, "
    "socketcand, systec, udp_multicast, unixbus, usb2can, vector, virtual; or install the python-can "
    "plugin that brings it",
)
TOO_LITTLE_KEPT = Code(
    "B12",
    "Too little of the recorded frames is kept",
    "keep_mb holds no finished file beside the one that is being written.",
    "Write keep_mb as twice file_mb or more.",
    _PAGE,
    example="machine.toml:36: buses.can0.record.keep_mb = 599: keeps no finished file beside the one being "
    "written, of up to 300 MB. Remedy: keep 600 MB or more, or write smaller files (file_mb)",
)
DBC_FILE = Code(
    "B13",
    "The DBC file cannot be used",
    "It is not there, cannot be read, describes no messages, or cantools is not installed.",
    "Correct the path, or export the file from its tool again. cantools comes with pip install "
    "'daqsvc[dbc]'.",
    _PAGE,
    example='machine.toml:26: streams.housing.layout.dbc = "x.dbc": there is no file /etc/daqsvc/x.dbc. '
    "Remedy: correct the path; a relative one starts at the directory of the machine file",
)
DBC_SIGNAL = Code(
    "B14",
    "A signal of the DBC file cannot be used",
    "No frame or quantity can have its length, place, type or scale in the DBC file.",
    "Correct the signal in the DBC file.",
    _PAGE,
    example='machine.toml:30: streams.housing.layout.channels[0].signals[0] = "AccelX": has the scale 0 in '
    "the DBC file, which would make every sample the same. Remedy: write in the DBC file what one "
    "count of the raw value is worth, e.g. (0.0005,0)",
)
NOT_IN_ONE_FRAME = Code(
    "B15",
    "Channels of one stream do not come together",
    "All channels of a stream have the same number of samples in each frame. Signals on different pages "
    "of a multiplexer never come in one frame.",
    "Make a stream of each group that comes together.",
    _PAGE,
    example='machine.toml:31: streams.housing.layout.channels[1].signals = ["AccelY"]: has 1 sample in a '
    'frame, but channel "x" has 2. Remedy: name as many signals for every channel of the stream',
)
UNIT_ADDRESS = Code(
    "B16",
    "No unit on a serial line has this address",
    "Units of Modbus on a serial line have addresses 1 to 247. 0 is for all of them, and none answers.",
    "Write the address that is set in the unit.",
    "modbus.md",
    example="machine.toml:43: streams.trend.layout.unit = 250: is no address of a unit on a serial line. "
    "Remedy: take 1 to 247, as set in the unit",
)
NO_ROOM_FOR_REGISTERS = Code(
    "B17",
    "The registers do not fit",
    "A reply of Modbus has room for 125 registers, addresses end at 65535, and a ring must be small "
    "enough for its counter.",
    "Leave out channels, or correct address, depth or number of samples.",
    "modbus.md",
    example="machine.toml:73: streams.ring.layout.address = 65000: leaves no room: the samples would end at "
    "register 67047, beyond 65535. Remedy: correct the address, or the number of samples",
)
FORBIDDEN_REGISTERS = Code(
    "B18",
    "A channel lies in forbidden registers",
    "forbidden lists registers that must never be read, since reading changes something in the unit.",
    "Leave out the channel, or narrow the forbidden range.",
    "modbus.md",
    example="machine.toml:48: streams.trend.layout.channels[0].address = 100: lies in the forbidden "
    "registers 100 to 110. Remedy: leave out the channel, or narrow the forbidden range",
)
WRITE_NOT_ALLOWED = Code(
    "B19",
    "The bus does not allow this write",
    "Nothing is written to a unit unless the table of the bus lists the registers.",
    "Add the registers to writes of the bus, if they may be written.",
    "modbus.md",
    example='machine.toml:18: streams.s.layout.page.select = 149: would have to be written, and bus "io" '
    "does not allow it. Remedy: add { unit = 1, address = 149, count = 1 } to writes in [buses.io]",
)
REGISTERS_OVERLAP = Code(
    "B20",
    "Registers are used twice",
    "Two channels share a register, or a register that steers the reading lies among the samples.",
    "Compare addresses and types with the register map of the unit. A float32 or int32 takes two registers.",
    "modbus.md",
    example='machine.toml:13: streams.s.layout.channels[1].address = 1: is part of float32 "a" too, which '
    "takes registers 0 to 1. Remedy: correct the two: float32 takes 2 registers, so the next number "
    "begins at 2 or later",
)
BITS = Code(
    "B21",
    "The bits are no part of the register",
    "bits names the lowest bit and the number of bits of an unsigned type. These do not lie in it.",
    "Write e.g. bits = [0, 4] for the lowest four.",
    "modbus.md",
    example="machine.toml:48: streams.trend.layout.channels[0].bits = [30, 12]: are no part of uint32. "
    "Remedy: write [lowest bit, number of bits] of an unsigned type that holds them, e.g. [0, 4]",
)
RING_DEPTH = Code(
    "B22",
    "The ring of the unit has no fitting depth",
    "If the depth is no power of two, the place of a sample is not known once the counter has wrapped.",
    "Set the device to a depth of 2, 4, 8, ... places.",
    "modbus.md",
    example="machine.toml:74: streams.ring.layout.depth = 1000: is not a power of two: where a sample lies "
    "would not be known once the counter wraps. Remedy: set the device to 512 or 1024 places",
)
NOT_PLAYABLE = Code(
    "B23",
    "The recording cannot be played",
    "It is no file, has an ending that no reader is known for, or cannot be read while it is written.",
    "Name a candump log, BLF, ASC, MDF or a table of samples; convert others.",
    "replay.md",
    example='machine.toml:10: buses.tape.file = "gap.db": is a data base, which cannot be played. Remedy: '
    "make a BLF of it: can_logconvert gap.db gap.blf",
)
PORT_MAY_CHANGE = Code(
    "B24",
    "The name of the port may change",
    "Names such as /dev/ttyUSB0 are given in the order of plugging. After re-plugging another device may "
    "have it.",
    "Write the path below /dev/serial/by-id.",
    "serial.md",
    example='machine.toml:19: buses.cobs.port = "/dev/ttyUSB0": may be another device once a port has been '
    "re-plugged. Remedy: write its path below /dev/serial/by-id (ls -l /dev/serial/by-id)",
)
BUS_OPTION = Code(
    "B25",
    "The driver cannot use an option of the bus",
    "The interface or port refuses a value of the table of the bus.",
    "Correct the option that the message names, as the manual of the interface has it.",
    _PAGE,
    example="/etc/daqsvc/machine.toml: buses.logger: depth is odd; write an even one",
)
MANUALS_NUMBER = Code(
    "B26",
    "The address looks like the number of a manual",
    "Manuals often count holding registers from 40001 and input registers from 30001. On the line they "
    "begin at 0.",
    "Take 40001 or 30001 off, if the manual counts so. A device that really has such addresses is read as "
    "it is.",
    "modbus.md",
    example="machine.toml:48: streams.trend.layout.channels[0].address = 40018: looks like a number of the "
    'manual, where registers begin at 40001. Remedy: write address = 17 and table = "holding", as registers '
    "begin at 0 here; leave it if the device has such addresses",
)
DEVICE_ABSENT = Code(
    "B27",
    "The device is not there at the start",
    'The port or interface of a bus cannot be opened, and start = "error" means that the service needs it.',
    'Plug the device in, or correct its name. With start = "retry" the service waits for it.',
    "driver-contract.md",
    "CAN bus 'can0' (socketcan can0): it cannot be opened: this kernel has no SocketCAN; `modprobe can-"
    "raw`, or use another interface",
)
LAYOUT = Code(
    "B28",
    "The layout contradicts itself",
    "A frame as the machine file or the DBC file describes it cannot exist, or cannot carry the values.",
    "Correct what the message names, as the device sends it.",
    _PAGE,
    "a float field of 24 bits cannot be; use 1 to 64 (float: 32, 64)",
)
LINK_LOST = Code(
    "B29",
    "The bus or the port cannot be used for now",
    "Its device is unplugged, switched off or taken, or nobody listens at its address. It is tried again "
    "until "
    "it is there.",
    "Look at power, cable and address. Nothing else is to be done: the service takes it up again by itself.",
    "driver-contract.md",
    "serial port 'line' (/dev/ttyUSB0): it cannot be opened: there is no /dev/ttyUSB0; plug the device "
    "in, or "
    "correct port; it is being tried again",
)
LEFT_OUT_AT_START = Code(
    "B30",
    "A bus is left out until the next start",
    'Its device was not there when the service started, and start = "ignore" means to go on without it.',
    'Restart the service when the device is there. With start = "retry" it is tried again.',
    "driver-contract.md",
    "CAN bus 'can0': nobody is there; it is left out until the service starts again, as start = 'ignore' "
    "asks for",
)
DRIVER_FAILED = Code(
    "B31",
    "A driver has failed",
    "A mistake in the driver, or in the library or adapter below it. The driver begins again.",
    "Update the driver of the adapter. If it happens again, report it with the lines of the log before.",
    "driver-contract.md",
    "the reader of CAN bus 'can0' (socketcan can0) failed",
)
NO_ANSWER = Code(
    "B32",
    "A unit does not answer",
    "A unit of Modbus is switched off, has another address or line settings, or answers too late. It is "
    "asked "
    "now and then, so that the others are not held up.",
    "Look at power, address, baud rate, parity and timeout_ms. daqsvc sniff modbus shows who answers.",
    "modbus.md",
    "unit 3 at 10.0.0.20:502 has not answered within 500 ms; the unit is set aside, and asked again in 10 "
    "s, then "
    "after times that double up to 60 s",
)
REGISTER_REFUSED = Code(
    "B33",
    "A unit refuses a request",
    "The unit answers with an exception: it has no such register or function, or cannot read that many at "
    "once.",
    "Compare address, table and number of registers with the manual of the unit. See max_count, max_gap and "
    "forbidden.",
    "modbus.md",
    "stream 'housing': unit 3 refuses function 4: illegal data address (registers 100 to 103), which is "
    "counted "
    "from now on; compare address and table with the register map of the device",
)
NO_FRAME = Code(
    "B34",
    "What comes is no frame of the stream",
    "Bytes, lengths or checksums are not as the layout states, or the frame is of no stream of the machine "
    "file.",
    "Compare baud rate, framing, length, checksum and ids with the device. daqsvc sniff shows what it sends.",
    "driver-contract.md",
    "serial port 'line' (/dev/ttyUSB0) carries bytes that are no frame; they are counted and left out; the "
    'first line is "17": 1 column, the file lists 2 (seq, x). If it is all of them, remove the 1 column that '
    'the device does not send from line of the layout, or correct separator = ","',
)
SAMPLES_MISSING = Code(
    "B35",
    "Samples are missing",
    "The counter of the device shows a gap: the bus, the device or this computer has lost frames. Or the "
    "values are polled (Modbus), and a poll had no answer or took longer than rate_hz has time for.",
    "Look at the load of the bus, its cables and this computer. daqsvc status shows how many are missing. If "
    "they are polled, lower rate_hz, or look at timeouts and exceptions of the bus in daqsvc status.",
    "status.md",
    "stream 'shaft': samples are missing before index 81920, by now 24; further gaps are only counted",
)
NO_MEASUREMENT = Code(
    "B36",
    "Values of a stream are no measurements",
    "The device states that it has no value, or sends one that is not finite, e.g. as a sensor is broken.",
    "Look at the sensors behind the channels, and at their cables.",
    "status.md",
    "stream 'housing': no measurement in 3 of its values: the device states that it has none",
)
TIME_UNSURE = Code(
    "B37",
    "The time of samples is not certain",
    "The device has restarted, its counter does not go on, or its frames come late or unevenly. Each turn of "
    "a counter of lines that begins again at 0 after 999, 9999 or the like looks like a restart, too.",
    "Nothing, if the device was restarted. Else compare rate_hz and the counter with the device: of one that "
    "begins again at 0 after 255, bits = 8; after 65535, bits = 16.",
    "alignment.md",
    "stream 'shaft': the device has restarted its counter, or has not counted for a while; how many "
    "samples are "
    "missing is estimated from the clock",
)
NOT_BELIEVED = Code(
    "B38",
    "Nothing is judged by a stream for now",
    "Its samples contradict the machine file: another rate or scale, or samples that are lost all the time.",
    "Correct what the message names, in the machine file or in the device.",
    "status.md",
    "stream 'shaft': the device sends 3950 Hz, the file states 4000; correct rate_hz in the machine file, "
    "or the device's setting. Nothing is judged by it meanwhile",
)
NOT_ALIGNED = Code(
    "B39",
    "Two streams cannot be put on one time",
    "Their times are less certain than max_error_us allows, so that their samples are left out.",
    "Have the device send more often or with less delay, or raise max_error_us.",
    "alignment.md",
    "stream 'b' can be put on the grid of 'a' to 900 us only, worse than max_error_us = 200",
)
BUS_ERRORS = Code(
    "B40",
    "The CAN controller reports errors",
    "Frames are damaged or lost on the way: bit rate, termination or cable are wrong, or it is alone on "
    "the bus.",
    "Compare bit rates, and look at cable and terminating resistors (120 ohm at both ends).",
    "can.md",
    "CAN bus 'can0' (socketcan can0) is error-passive: its controller counts more than 127 errors and "
    "cannot flag errors any more; look at wiring, termination and bit rate",
)
BUFFER_FULL = Code(
    "B41",
    "A receive buffer was full",
    "Frames came faster than this computer took them, and some are lost.",
    "Raise receive_buffer_bytes of the bus, or relieve the computer.",
    "can.md",
    "CAN bus 'can0' (socketcan can0): the kernel dropped frames because its receive buffer was full",
)
FRAMES_UNRECORDED = Code(
    "B42",
    "Frames are not recorded",
    "The disk is full, too slow or gone, or the frames are of a kind that is not recorded. What is read "
    "from "
    "the bus goes on.",
    "Check the disk: room, speed, rights. frames_unrecorded counts what is missing.",
    "can.md",
    "CAN bus 'can0' (socketcan can0) cannot be recorded in /var/log/can: No space left on device",
)
PLAYED_OTHERWISE = Code(
    "B43",
    "A recording is not played as it is",
    "It has frames of other channels, leaps in time, or parts that cannot be read.",
    "Correct channel of the replayed bus, or cut the recording.",
    "replay.md",
    "replayed bus 'log': its time stamps leap back, or ahead by more than an hour",
)
LINE_SETTINGS = Code(
    "B44",
    "The port does not take the settings of the line",
    "A pseudo-terminal passes whole bytes only, without parity and with 8 data bits.",
    "Nothing, if a simulated device is behind it. Else correct the name of the port.",
    "serial.md",
    "/run/line is a pseudo-terminal, which passes whole bytes only: it is opened without parity",
)
NO_VALUE_MARK = Code(
    "B45",
    "A mark for no value would be a value",
    "Many Modbus devices write 0x8000 into an int16, or 0xFFFF into a uint16, when they have no value, e.g. "
    "of a broken sensor. Numbers of 32 bits have such marks, too. Without no_value and "
    "ok_between it is taken for one.",
    "Write no_value into the channel, as the device's manual has it, or ok_between with what the sensor can "
    "measure.",
    "modbus.md",
    example='machine.toml:73: sensors[2] ("de-temperature"): has no ok_between: 0x8000 in its int16, by '
    "which many devices mean that they have no value, would be -1638.4 degC. Remedy: write no_value = 0x8000 "
    "into its channel if the device's manual has it, or ok_between with the least and the greatest value "
    "that the sensor can measure",
)
TIMES_SHARED = Code(
    "B46",
    "Several lines may have the same time",
    "The unit of the device's time is longer than the time between two lines. If the device sends whole "
    "numbers, several lines have the same time. Each of them is a sample, in the order of arrival. But a "
    "single lost line is mostly not noticed, and of several lost in a row one may not be counted. Losses "
    "that go on are counted from about 3 % of the lines on; up to 1.25 % look like a slow device. If the "
    "unit is hardly shorter than the time between two lines, up to 2 % are taken for lost that are not.",
    "Have the device send a counter, or its time in a finer unit. Leave it if the device sends decimals that "
    "are finer than the time between lines.",
    "serial.md#lines-of-text",
    example='machine.toml:97: streams.timed.layout.time.unit = "s": is longer than the 0.01 s from line to '
    "line: if the device sends whole s, several lines have the same time. A single lost line is then mostly "
    'not noticed. Remedy: have the device send a counter, or ms with unit = "ms"; if it sends decimals, e.g. '
    "12.345 s, leave it",
)
NEVER_WHOLE = Code(
    "B47",
    "A waveform is never read whole",
    "A Modbus device replaces its block of samples before daqsvc has read all of it. 2048 samples take 17 "
    "requests. Each waits for its reply, and for the requests of other streams on the line. A block that "
    "was replaced meanwhile is a mixture of two, and is lost.",
    "Have the device measure less often, or with fewer samples. With trigger, raise every_s. Else relieve "
    "the line: a lower rate_hz of other streams, fewer requests (max_gap), a faster baud rate, a second bus.",
    "modbus.md#waveforms-by-example",
    example="stream 'wave': no block is read whole: reading one takes 4.7 s, and the device replaces it "
    "after about 4.2 s, so all of them are lost; have the device take blocks less often, or have fewer "
    "samples in a block, or fewer and rarer requests of other streams",
)
