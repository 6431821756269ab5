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
    example='machine.toml:70: pipeline.bearing.bearings[0] ("drive-end"): has both type and orders. Remedy: '
    'write type = "6205-2RS", or orders = { bpfi = .., bpfo = .., bsf = .., ftf = .. }, or geometry = { '
    "balls = .., ball_diameter_mm = .., pitch_diameter_mm = .. }",
)
TOO_SLOW_A_MACHINE = Code(
    "D02",
    "The machine is too slow for the bearing detector",
    "A window of the detector holds too few revolutions to tell the lines of a bearing.",
    "Remove [pipeline.bearing], and watch levels or trend values.",
    "bearing.md",
    example="machine.toml:65: pipeline.bearing: a window of 2.5 s has 12.5 revolutions at 300 rpm; the lines "
    "of a bearing need 25. Remedy: remove it: this machine is too slow for it",
)
WINDOW_TOO_SHORT = Code(
    "D03",
    "The window is too short",
    "It holds too few samples, revolutions, or periods of the lowest frequency for what is measured.",
    "Write the window_s that the message names, or have the device take longer blocks.",
    _PAGE,
    example="machine.toml:95: pipeline.levels.window_s = 0.01: 0.01 s at 640 Hz are fewer than 16 samples. "
    "Remedy: write window_s = 0.025 or more",
)
BAND_TOO_HIGH = Code(
    "D04",
    "The band ends above half of the sampling rate",
    "Samples show nothing above half of their rate.",
    "Sample faster, or end the band lower.",
    _PAGE,
    example="machine.toml:63: pipeline.levels.velocity_band_hz = [10.0, 500.0]: the band 10 Hz to 500 Hz "
    'must end below 500 Hz, half the rate of stream "housing" (sensor "accel-x"). Remedy: write '
    "velocity_band_hz = [10.0, 400.0]",
)
NEEDS_KEYPHASOR = Code(
    "D05",
    "A keyphasor is needed",
    "A phase, or the angle of the shaft, is only known with a mark once each revolution.",
    "Name a sensor of type keyphasor, or ask for what needs none.",
    _PAGE,
    example='machine.toml:93: pipeline.rotor_synchronous.speed_source = "keyphasor": needs a keyphasor, and '
    'none is named. Remedy: add keyphasor, or write speed_source = "fixed" or "orbit"',
)
HEALTHY_MODE = Code(
    "D06",
    "The first mode is not the healthy one",
    "The first mode of the bank is the rotor as [machine.rotor] describes it. It has no fault, and no "
    "figures of its own.",
    "Put the healthy mode first, with severity = normal and nothing else.",
    "rotor-figures.md",
    example="machine.toml:101: pipeline.rotor_bank.modes[0].damping_ratio = 0.10: differs from damping_ratio "
    "= 0.18 of [machine.rotor], the healthy rotor. Remedy: remove it, or correct one of the two",
)
MODE_WITHOUT_FAULT = Code(
    "D07",
    "A mode has no fault",
    "A mode must be worse than the healthy rotor, or nobody can tell them apart.",
    "Write what differs in the mode, or remove it.",
    "rotor-figures.md",
    example='machine.toml:109: pipeline.rotor_bank.modes[4].fault = "static_load": no figure of this mode '
    "fits that fault. Remedy: write e.g. static_load_um = [0.0, -10.0]",
)
MODE_UNSEEN = Code(
    "D08",
    "The probes cannot see the mode",
    "A probe that is AC-coupled shows no static position, and so no static load.",
    "Use DC-coupled probes, or remove the mode.",
    "rotor-figures.md",
    example="machine.toml:110: pipeline.rotor_bank.modes[4].static_load_um = [0.0, -5.0]: cannot be seen: a "
    "probe of the bank is AC-coupled and shows no static position. Remedy: use DC-coupled probes "
    "(ac_coupled = false), or remove the mode",
)
FALSE_ALARM_RATE = Code(
    "D09",
    "The rate of false alarms cannot be meant",
    "It would allow a false alarm at every revolution.",
    "Write e.g. 0.02 false alarms in 1000 revolutions.",
    "rotor-figures.md",
    example="machine.toml:99: pipeline.rotor_bank.false_alarms_per_1000_rev = 5e3: would be a false alarm at "
    "every revolution. Remedy: write e.g. 0.02",
)
NOISE_TOO_LARGE = Code(
    "D10",
    "The noise hides every motion of the shaft",
    "noise_um is as large as the clearance, within which the shaft moves.",
    "Correct noise_um (probes have some 0.1 to 5 um) or clearance_um.",
    "rotor-figures.md",
    example="machine.toml:100: pipeline.rotor_bank.noise_um = 200.0: hides every motion within clearance_um "
    "= 100. Remedy: correct one of the two; probes have some 0.1 to 5 um",
)
MODE_TOUCHES = Code(
    "D11",
    "A mode would touch the stator",
    "The model of the mode has no contact, and by its figures the orbit does not fit the clearance.",
    "Write rub = true in the mode, or a smaller fault.",
    "rotor-figures.md",
    example='machine.toml:104: pipeline.rotor_bank.modes[1] = { name = "F1", damping_ratio = 0.02, severity '
    '= "alert" }: mode "F1" would touch the stator: a whirl of 250 um about a rest at 10 um does not '
    "fit a clearance of 100 um; its model has no contact. Remedy: write rub = true in it, or a "
    "smaller fault",
)
NEEDS_ROTOR = Code(
    "D12",
    "Data of the rotor are missing",
    "The detector compares the motion with a model of the rotor, and needs its figures in [machine.rotor].",
    "Add what the message names, or remove the table of the detector.",
    "rotor-figures.md",
    example="machine.toml:88: pipeline.rotor_bank: the model bank needs the rotor's data. Remedy: write a "
    "table [machine.rotor], or remove [pipeline.rotor_bank]",
)
NEEDS_ANGLES = Code(
    "D13",
    "The direction of a probe is not known",
    "An orbit is put together of two probes. Each needs the angle at which it points.",
    "Add angle_deg to the sensors.",
    "rotor-figures.md",
    example='machine.toml:98: pipeline.rotor_bank.probes[1] = "probe-y": sensor "probe-y" does not state '
    'where it points. Remedy: add angle_deg to the entry "probe-y" of sensors, e.g. 90.0',
)
NO_REVOLUTIONS = Code(
    "D14",
    "The bank would not learn how the rotor runs now",
    "The rotor comes from a run-up. Its unbalance and its rest may have changed since, and are learnt "
    "again at start.",
    "Write e.g. calibrate_revolutions = 50.",
    "calibration.md",
    example="machine.toml:98: pipeline.rotor_bank.calibrate_revolutions = 0: is 0, with the rotor from a "
    "run-up: its unbalance and its rest may have changed since. Remedy: write e.g. "
    "calibrate_revolutions = 50",
)
RACES_ALIKE = Code(
    "D15",
    "The races cannot be told apart by two sensors",
    "The two sensors are the same or sampled too slowly to show which race a shock comes from.",
    "Name a sensor that moves with the rotor, sample faster, or remove rotor_sensor.",
    "bearing.md",
    example='machine.toml:74: pipeline.bearing.bearings[0].rotor_sensor = "accel-de": is the sensor on the '
    "housing. Remedy: name the one that moves with the rotor",
)
CALIBRATION_FILE = Code(
    "D16",
    "The calibration cannot be used",
    "The file is not there or damaged, was written by another program, or is of another machine, other "
    "sensors or another speed.",
    "Correct the path, or make the file again with daqsvc calibrate.",
    "calibration.md",
    example="machine.toml: pipeline.rotor_synchronous.calibration = 'up.toml': /etc/daqsvc/up.toml: No such "
    "file or directory; name a file that daqsvc calibrate wrote",
)
NO_OBSERVERS = Code(
    "D17",
    "No observers can be made of the figures of the bank",
    "With these figures the equations of an observer have no stable solution. Usually one figure has "
    "another unit.",
    "Correct noise_um, process_noise, modes or [machine.rotor].",
    "rotor-figures.md",
    example="machine.toml: pipeline.rotor_bank: its observers cannot be made of these figures (normalised "
    "rotor: zeta is 0.0; it must be a finite number above 0); correct noise_um, process_noise, "
    "modes, or [machine.rotor]",
)
UNFIT_BEARING = Code(
    "D18",
    "The bearing detector cannot be made",
    "The type of a bearing is not in the catalogue, or its orders do not fit each other. Or its model does "
    "not fit the sampling rate, or what was learnt is of another machine.",
    "Do what the message asks for at the key that it names.",
    "bearing.md",
    example="machine.toml: pipeline.bearing.bearings[1].orders: BPFI 7 does not fit BPFO 3.053 and FTF "
    "0.3817, which make it 4.945; check the four orders",
)
HEALTHY_STATE = Code(
    "D19",
    "The healthy state is learnt again, or will be lost",
    "The file that keeps what was learnt of the healthy machine cannot be read, used or written.",
    "Make sure that the machine is in good order now, or calibrate it again. Check the disk.",
    "calibration.md",
    "the healthy state of the rotor is measured again: /var/lib/daqsvc/rotor.toml: schema_version is "
    "missing; restore the file, or calibrate again",
)
NO_DETECTOR = Code(
    "D20",
    "No detector reads the samples that fail",
    "A stream has failed that no detector reads. An alarm would not show it.",
    "Add a detector for the stream, or remove the stream.",
    _PAGE,
    "no samples of stream 'spare' for more than 2.0 s; check bus and device; no detector reads them",
)
SENSOR_NOT_OK = Code(
    "D21",
    "A sensor is not OK",
    "What it sends is not what a working sensor delivers: it is dead, clipped, outside its OK "
    "limits or loose.",
    "Look at the sensor, its cable and its supply. The message states what is wrong with its signal.",
    "alarms.md",
    "alarm sensor-ok/probe-x raised: sensor-ok/probe-x alert: probe-x not OK: probe-x does not move at "
    "all (0 um): "
    "dead or disconnected",
)
NOT_JUDGED = Code(
    "D22",
    "A sensor or a detector cannot be judged",
    "No samples come, or too few: the device is off, its bus is interrupted, or many samples are lost.",
    "The message names the stream and, where it is known, the reason. Look at the device and its bus; daqsvc "
    "status shows both. Alarms keep their states until samples come again.",
    "alarms.md",
    "alarm sensor-ok/probe-x raised: sensor-ok/probe-x alert: probe-x cannot be judged: no samples of stream "
    "'shaft' for more than 2.0 s; check bus and device",
)
