"""Detectors."""

from daqsvc.errors.code import Code

_PAGE = "detectors.md"

BEARING_FIGURES = Code(
    "D01",
    "The figures of the bearing do not fit each other",
    "A bearing is given once: by its type, its orders or its geometry. Orders are per revolution of the "
    "shaft and obey ftf < 0.5 < bpfo < bpfi, and bpfo + bpfi is the number of balls.",
    "Compare the figures with the data sheet of the bearing.",
    "bearing.md",
)
TOO_SLOW_A_MACHINE = Code(
    "D02",
    "The machine is too slow for the bearing detector",
    "A window of the detector holds too few revolutions to tell the lines of a bearing.",
    "Remove [pipeline.bearing], and watch levels or trend values.",
    "bearing.md",
)
WINDOW_TOO_SHORT = Code(
    "D03",
    "The window is too short",
    "It holds too few samples, revolutions, or periods of the lowest frequency for what is measured.",
    "Write the window_s that the message names, or have the device take longer blocks.",
    _PAGE,
)
BAND_TOO_HIGH = Code(
    "D04",
    "The band ends above half of the sampling rate",
    "Samples tell nothing above half of their rate.",
    "Sample faster, or end the band lower.",
    _PAGE,
)
NEEDS_KEYPHASOR = Code(
    "D05",
    "A keyphasor is needed",
    "A phase, or the angle of the shaft, is only known with a mark once each revolution.",
    "Name a sensor of type keyphasor, or ask for what needs none.",
    _PAGE,
)
HEALTHY_MODE = Code(
    "D06",
    "The first mode is not the healthy one",
    "The first mode of the bank is the rotor as [machine.rotor] describes it. It has no fault, and no "
    "figures of its own.",
    "Put the healthy mode first, with severity = normal and nothing else.",
    "rotor-figures.md",
)
MODE_WITHOUT_FAULT = Code(
    "D07",
    "A mode has no fault",
    "A mode that does not differ from the healthy rotor for the worse cannot be told from it.",
    "Write what differs in the mode, or remove it.",
    "rotor-figures.md",
)
MODE_UNSEEN = Code(
    "D08",
    "The probes cannot see the mode",
    "A probe that is AC-coupled shows no static position, and so no static load.",
    "Use DC-coupled probes, or remove the mode.",
    "rotor-figures.md",
)
FALSE_ALARM_RATE = Code(
    "D09",
    "The rate of false alarms cannot be meant",
    "It would allow a false alarm at every revolution.",
    "Write e.g. 0.02 false alarms in 1000 revolutions.",
    "rotor-figures.md",
)
NOISE_TOO_LARGE = Code(
    "D10",
    "The noise hides every motion of the shaft",
    "noise_um is as large as the clearance, within which the shaft moves.",
    "Correct noise_um (probes have some 0.1 to 5 um) or clearance_um.",
    "rotor-figures.md",
)
MODE_TOUCHES = Code(
    "D11",
    "A mode would touch the stator",
    "The model of the mode knows no contact, and by its figures the orbit does not fit the clearance.",
    "Write rub = true in the mode, or a smaller fault.",
    "rotor-figures.md",
)
NEEDS_ROTOR = Code(
    "D12",
    "Data of the rotor are missing",
    "The detector compares the motion with a model of the rotor, and needs its figures in [machine.rotor].",
    "Add what the message names, or remove the table of the detector.",
    "rotor-figures.md",
)
NEEDS_ANGLES = Code(
    "D13",
    "The direction of a probe is not known",
    "An orbit is put together of two probes. Each needs the angle at which it points.",
    "Add angle_deg to the sensors.",
    "rotor-figures.md",
)
NO_REVOLUTIONS = Code(
    "D14",
    "The bank would not learn how the rotor runs now",
    "The rotor comes from a run-up. Its unbalance and its rest may have changed since, and are learnt "
    "again at start.",
    "Write e.g. calibrate_revolutions = 50.",
    "calibration.md",
)
RACES_ALIKE = Code(
    "D15",
    "The races cannot be told by two sensors",
    "The two sensors are the same or sampled too slowly to show which race a shock comes from.",
    "Name a sensor that moves with the rotor, sample faster, or remove rotor_sensor.",
    "bearing.md",
)
CALIBRATION_FILE = Code(
    "D16",
    "The calibration cannot be used",
    "The file is not there or damaged, was written by another program, or is of another machine, other "
    "sensors or another speed.",
    "Correct the path, or make the file again with daqsvc calibrate.",
    "calibration.md",
)
NO_OBSERVERS = Code(
    "D17",
    "No observers can be made of the figures of the bank",
    "With these figures the equations of an observer have no stable solution. Usually one figure has "
    "another unit.",
    "Correct noise_um, process_noise, modes or [machine.rotor].",
    "rotor-figures.md",
)
UNFIT_BEARING = Code(
    "D18",
    "The bearing detector cannot be made",
    "The type of a bearing is not in the catalogue, its orders do not fit each other, its model does not "
    "fit the sampling rate, or what was learnt is of another machine.",
    "Do what the message says at the key that it names.",
    "bearing.md",
)
HEALTHY_STATE = Code(
    "D19",
    "The healthy state is learnt again, or will be lost",
    "The file that keeps what was learnt of the healthy machine cannot be read, used or written.",
    "Make sure that the machine is in good order now, or calibrate it again. Check the disk.",
    "calibration.md",
    "the healthy state of the rotor is measured again: /var/lib/daqsvc/rotor.toml was made at another speed",
)
NO_DETECTOR = Code(
    "D20",
    "No detector reads the samples that fail",
    "A stream has failed that no detector reads. An alarm would not show it.",
    "Add a detector for the stream, or remove the stream.",
    _PAGE,
    "no samples of spare for 5.0 s; check bus and device; no detector reads them",
)
SENSOR_NOT_OK = Code(
    "D21",
    "A sensor is not OK",
    "What it sends is not what a working sensor delivers: it is dead, clipped, outside its OK "
    "limits or loose.",
    "Look at the sensor, its cable and its supply. The message says what is wrong with its signal.",
    "alarms.md",
    "alarm sensor-ok/probe-x raised: probe-x is not OK: probe-x does not move at all (0 um): dead or "
    "disconnected",
)
NOT_JUDGED = Code(
    "D22",
    "A sensor or a detector cannot be judged",
    "No samples come, or too few: the device is off, its bus is interrupted, or many samples are lost.",
    "The message names the stream and, where it is known, the reason. Look at the device and its bus; daqsvc "
    "status shows both. Alarms keep their states until samples come again.",
    "alarms.md",
    "alarm sensor-ok/probe-x raised: probe-x cannot be judged: no samples of stream 'shaft' for more than "
    "2.0 s; check bus and device",
)
