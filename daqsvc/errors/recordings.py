"""Recordings and snapshots."""

from daqsvc.errors.code import Code

_PAGE = "analyze.md"

NOT_FOUND = Code(
    "R01",
    "The recording cannot be opened",
    "It is not there, this user may not read it, or it is a folder or a device.",
    "Correct the path, or give this user the right to read the file.",
    _PAGE,
    "daqsvc export: shaft.csv cannot be read: there is no such file; correct the path",
)
UNKNOWN_FORMAT = Code(
    "R02",
    "The file is of no kind that can be read",
    "The ending of its name shows the kind. It is none that is known, or the file has contents "
    "of another kind.",
    "Save it as one of the kinds that the message lists, with the ending of that kind.",
    _PAGE,
    "daqsvc export: shaft.wav is not a WAV file: it begins with b'RF64', not with RIFF; save it as WAV "
    "(not RF64 or RIFX)",
)
DAMAGED = Code(
    "R03",
    "The recording is damaged or was cut short",
    "What is in the file contradicts itself, or its end is missing: a copy or the logger stopped too early.",
    "Copy the file again, or save it again with the program that wrote it.",
    _PAGE,
    "daqsvc export: shaft.wav is cut short: its 'data' chunk should have 8000 bytes and has 4000; copy "
    "or save it again",
)
TOO_LARGE = Code(
    "R04",
    "The recording takes more memory or time than it may",
    "One recording may take a part of the memory only, so that a damaged one cannot stop the box.",
    "Give more with --max-memory, or cut the recording into shorter ones.",
    _PAGE,
    "daqsvc export: shaft.csv cannot be read: it takes more memory than it may; allow more (--max-memory,"
    " or max_memory_gb of a replayed bus; it is 0.05 GB), or if it is not that large, it is damaged: copy "
    "or save it again",
)
NO_SUCH_CHANNEL = Code(
    "R05",
    "A channel is not in the recording",
    "No column or variable has the name of the channel, or several may be meant.",
    "Choose one with --map NAME=VARIABLE. The message lists what the file has.",
    _PAGE,
    "daqsvc export: run.npz has no channel 'x_um'; it holds ch1 (1000), ch2 (1000)",
)
NOT_NUMBERS = Code(
    "R06",
    "The table does not hold numbers as it should",
    "A cell holds no number, a line has too few or too many columns, or a unit or date can be read two ways.",
    "Correct the line that the message names, or export the table again.",
    _PAGE,
    "daqsvc export: shaft.csv, line 3, column 1 (a): 'foo' is not a number; correct the file",
)
RATE_UNKNOWN = Code(
    "R07",
    "The sampling rate is not known",
    "The file states no sampling rate and has no column of time, or the rate that it states is none.",
    "Give it with --fs, in Hz.",
    _PAGE,
    "daqsvc export: the sampling rate of run.csv is not known: the file does not state one. Give it with "
    "--fs, in Hz",
)
RATE_CONTRADICTED = Code(
    "R08",
    "Two sampling rates contradict each other",
    "The file, its column of time, the machine file or --fs state different rates. Frequencies would be "
    "wrong.",
    "Leave --fs out, or correct the one that is wrong.",
    _PAGE,
    "the sampling rate of run.csv is 2000 Hz by the file and 5000 Hz as given: leave --fs out, or correct it",
)
GAPS = Code(
    "R09",
    "Too many samples are missing",
    "By its time the recording has long gaps, in which nothing is known.",
    "Cut the recording at the gap, or give logs that follow each other without long gaps.",
    _PAGE,
    "run.csv lacks 5,000 of 9,000 samples by its time column 't', the most behind sample 2,000; cut the "
    "recording there",
)
NOT_TOGETHER = Code(
    "R10",
    "The channels were not taken together",
    "They have different lengths or times, and cannot be compared sample by sample.",
    "Map only channels that were taken together, or record them again.",
    _PAGE,
    "the channels of run.npz have different lengths: x 1000, y 900; map only channels taken together",
)
TOO_SHORT = Code(
    "R11",
    "The recording is empty or too short",
    "It holds no samples, or fewer than what is computed needs.",
    "Give a longer recording.",
    _PAGE,
    "daqsvc export: run.csv has a header but no samples; give a file with samples",
)
NEEDS_MACHINE_FILE = Code(
    "R12",
    "A CAN log needs a machine file",
    "A log holds frames. Only the layouts of a machine file state which samples are in them.",
    "Name the machine file before the log, and leave out --map and --fs.",
    _PAGE,
    "daqsvc export: plant.blf is a CAN log, which only the layouts of a machine file make sense of: name "
    "that first",
)
NOT_IN_LOG = Code(
    "R13",
    "The log does not fit the machine file",
    "It has no frame of a stream of the machine file, or frames that may be of several buses.",
    "Name the machine file of this bus, or correct its ids.",
    _PAGE,
    "pump.blf: not judged: pump.blf has no frame of a stream of pump.toml",
)
UNFIT_SAMPLES = Code(
    "R14",
    "The samples are not what a working sensor delivers",
    "They are clipped, stuck at one value, too weak, or in another unit.",
    "Look at sensor, cable and range, and record again. --map names the channel that is meant.",
    _PAGE,
    "shaft.csv: not judged: channel is clipped: 310 of 8000 samples are at 200; use a sensor or a gain "
    "with a larger range",
)
NOT_JUDGED = Code(
    "R15",
    "The recording cannot be judged",
    "What it shows does not fit what was stated of the machine: speed, keyphasor, length or state.",
    "Do what the message asks for: correct the option, or record again.",
    _PAGE,
    "run.csv: not judged: run.csv has no channel for probe-y, keyphasor of pump.toml; name its variable, "
    "e.g. --map "
    "probe-y=VARIABLE. It holds x",
)
NOT_HEALTHY = Code(
    "R16",
    "The recording cannot be that of a healthy machine",
    "A calibration needs a machine in good order at steady speed, or running up. This one is too short, "
    "not "
    "steady, or already shows a change.",
    "Record the machine in good order, as the page on calibration describes.",
    "calibration.md",
    "not calibrated: only 12 usable revolutions; a baseline needs 50: give a longer recording",
)
SNAPSHOT = Code(
    "R17",
    "The snapshot cannot be read",
    "It is damaged, was cut short, or is none of daqsvc.",
    "Copy it again, or give another one.",
    "recorder.md",
    "daqsvc replay: pump.mcap cannot be read: it is no MCAP file: it does not begin as one; it may be "
    "damaged: copy it again, or give another one",
)
NOT_REPLAYABLE = Code(
    "R18",
    "The snapshot cannot be judged again",
    "The machine file in it is of another version, or the one that was named has other streams.",
    "Name a machine file with the streams of the snapshot.",
    "replay.md",
    "daqsvc replay: pump.mcap has no machine file that can be used: name one behind it",
)
NOT_HELD = Code(
    "R19",
    "The format cannot hold the recording",
    "Each format has limits: of size, of rates, of names.",
    "Write the format that the message names, or one stream alone with --stream.",
    "export.md",
    "daqsvc export: stream shaft has 5.2 GB of samples, and a WAV file holds 4.29; write .parquet or .mf4",
)
