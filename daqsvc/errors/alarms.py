"""Alarms."""

from daqsvc.errors.code import Code

_PAGE = "alarms.md"

RESERVED_NAME = Code(
    "A01",
    "The name is that of an alarm of the service itself",
    "The service raises alarms of its own, e.g. on lost samples. Two alarms of one name could not be told"
    " apart.",
    "Give the alarm another name.",
    _PAGE,
    example='machine.toml:130: alarms[2].name = "alarm-flood": is an alarm that the service raises itself. '
    "Remedy: give this one another name",
)
VOTE = Code(
    "A02",
    "The vote cannot be reached",
    "More sensors are asked for than there are, or sensors of different units would share one setpoint.",
    "Write a smaller vote, or add sensors of one unit.",
    _PAGE,
    example="machine.toml:142: alarms[3].vote = 3: cannot be reached by 2 sensors. Remedy: write vote = 2 or "
    "less, or add sensors",
)
NO_SETPOINT = Code(
    "A03",
    "The alarm has no setpoint",
    "Without alert and danger the alarm would never come.",
    "Add alert, danger or both.",
    _PAGE,
    example='machine.toml:109: alarms[0] ("shaft-vibration-x"): has neither alert nor danger. Remedy: add '
    "alert, danger or both",
)
SETPOINT_ORDER = Code(
    "A04",
    "The setpoints are in the wrong order",
    "alert comes before danger: upper setpoints rise towards danger, lower ones fall. Setpoints beside "
    "zones keep to the order of the zones.",
    "Swap the two, or correct one.",
    _PAGE,
    example="machine.toml:113: alarms[0].alert = 80.0: must be below danger = 60. Remedy: swap the two, or "
    "correct one of them",
)
UNFIT_SETPOINT = Code(
    "A05",
    "The setpoint does not go with the measure",
    "Most measures are never negative and have upper setpoints only. A phase has a reference, and "
    "amplitudes may have a phase.",
    "Remove the key, or take a measure that it goes with.",
    _PAGE,
    example="machine.toml:113: alarms[0].alert = -40.0: must be greater than 0: rms is never less. Remedy: "
    "write a positive setpoint",
)
NEVER_REACHED = Code(
    "A06",
    "The setpoint is never reached",
    "A sensor with such a value counts as broken, the channel cannot carry it, or the stator does not let "
    "the shaft move as far.",
    "Correct the setpoint, or the limits of the sensor.",
    _PAGE,
    example='machine.toml:113: alarms[0].alert = 40.0: is never reached: the channel of "probe-x" carries '
    "8.327 um at most. Remedy: correct it, or scale and sensitivity of the channel and its sensor",
)
DEADBAND = Code(
    "A07",
    "The alarm would never return",
    "An alarm returns when the value is back by the deadband. This one is as wide as the setpoint or the "
    "room between.",
    "Write a smaller deadband, e.g. a twentieth of the setpoint.",
    _PAGE,
    example="machine.toml:115: alarms[0].deadband = 40.0: must be smaller than the setpoint 40, or the alarm "
    "never returns. Remedy: write e.g. deadband = 2",
)
UNFIT_MEASURE = Code(
    "A08",
    "The measure does not go with the sensor",
    "Velocities come from accelerometers and velocity sensors, gaps from proximity probes, values from "
    "sensors that send a level.",
    "Write the measure that the message names, or correct the type of the sensor.",
    _PAGE,
    example='machine.toml:142: alarms[3].measure = "gap_voltage": is not known: "probe-x" has no '
    "sensitivity_mv_per_unit. Remedy: add sensitivity_mv_per_unit and zero_v to the sensor, or write "
    'measure = "peak_to_peak", with setpoints from peak to peak',
)
NOT_MEASURED = Code(
    "A09",
    "Nothing measures the level",
    "An alarm on the level of a sensor needs a detector that measures it.",
    "Write a table [pipeline.levels]; it may be empty.",
    _PAGE,
    example='machine.toml:54: alarms[0].sensor = "accel-de": nothing measures its level. Remedy: write a '
    "table [pipeline.levels] (it may be empty), or remove the alarm",
)
NO_REFERENCE = Code(
    "A10",
    "The reference of the phase is missing",
    "Setpoints of a phase are how far it may be from that of the machine in good order.",
    "Add reference_deg, the phase that was measured then.",
    _PAGE,
    example='machine.toml:90: alarms[0] ("housing"): does not state from where 1x_phase_lag counts: its '
    "setpoints are how far it may be from a reference, either way. Remedy: add reference_deg, the phase of "
    "the machine in good order, e.g. reference_deg = 135.0",
)
TRIP_MULTIPLY = Code(
    "A11",
    "trip_multiply has no use here",
    "It raises alert and danger while the machine starts up. That needs [alarm_handling.start_up] and "
    "setpoints above 0.",
    "Add what is missing, or remove trip_multiply.",
    _PAGE,
    example="machine.toml:145: alarms[3].trip_multiply = 2.0: never holds: nothing states when the machine "
    "starts up. Remedy: write a table [alarm_handling.start_up], or remove it",
)
ALWAYS_STARTING = Code(
    "A12",
    "The machine would always be starting up",
    "The range of start_up holds the nominal speed.",
    "End the range below machine.speed_rpm.",
    _PAGE,
    example="machine.toml:136: alarm_handling.start_up.between = [60.0, 660.0]: holds machine.speed_rpm, 600 "
    "rpm: the machine would always be starting up. Remedy: end it below 600, e.g. between = [60, 540]",
)
SILENT_DETECTOR = Code(
    "A13",
    "The detector would never raise the alarm",
    "The alarm follows a detector that is not configured, or that gives probabilities only.",
    "Write the table of the detector, correct its rule, or remove the alarm.",
    _PAGE,
    example='machine.toml:102: alarms[0].detector = "bearing": this detector is not configured. Remedy: '
    "write a table [pipeline.bearing], or remove the alarm",
)
UNFIT_ZONES = Code(
    "A14",
    "The zones do not go with the sensor or the measure",
    "Zones of ISO 20816-3 are of the velocity of a housing, by group and support, or of the displacement "
    "of a shaft.",
    "Write the zones that go with the sensor, or setpoints in place of them.",
    _PAGE,
    example='machine.toml:104: alarms[1].zones = { standard = "iso-20816-3", group = 1, support = "rigid" }: '
    'are those of the velocity of a housing, but "probe-x" is a proximity probe. Remedy: write zones '
    '= { standard = "iso-20816-3", shaft = true }',
)
NOT_OF_STANDARD = Code(
    "A15",
    "The measure is not that of the standards",
    "Limits of shaft vibration in ISO 20816 and API 670 are from peak to peak, which is about twice the "
    "peak value.",
    'Write measure = "peak_to_peak", with setpoints from peak to peak.',
    _PAGE,
    example='machine.toml:237: alarms[1].measure = "peak": is from the mean to the farthest point; the '
    "limits of shaft vibration in ISO 20816 and API 670 are peak to peak, about twice that. Remedy: "
    'write measure = "peak_to_peak", with setpoints from peak to peak',
)
CANNOT_JUDGE = Code(
    "A16",
    "An alarm cannot be judged",
    "The detector that the alarm follows does not give its measure.",
    "Correct the measure of the alarm. The message lists those that there are.",
    _PAGE,
    "alarm housing cannot be judged: levels/probe-x measures rms, not 'velocity_rms'; correct the alarm's "
    "measure",
)
ALARM_STANDS = Code(
    "A17",
    "An alarm of the machine is active",
    "A value is beyond a setpoint of the machine file, or a detector has found a fault. The message names "
    "it. The service itself works as it should.",
    "Look at the machine. daqsvc alarms shows all alarms; daqsvc ack NAME acknowledges this one.",
    "commands.md",
    "alarm probe-x raised: probe-x alert: rms of probe-x is 36.2 um, alert limit 35 um",
)
BAND_WITHOUT_1X = Code(
    "A18",
    "The alarm does not see 1X of the machine",
    "The band of the velocity does not hold the speed of the machine (speed_rpm / 60). An unbalance, which "
    "shows once a revolution, is not in the value. Mostly the device sends too slowly for a wider band.",
    "Have the device send faster: at least 2.56 times the highest frequency that counts. Or widen "
    "velocity_band_hz where the rate allows it, or write another measure.",
    _PAGE,
    example='machine.toml:57: alarms[0].measure = "velocity_rms": does not see 1X: "drive-end-rms" watches '
    "10 Hz to 24 Hz, and the machine turns at 29.93 Hz (1796 rpm). An unbalance does not show. Stream "
    '"drive-end" has rate_hz = 60. Remedy: have the device send 76.7 samples a second or more, and end the '
    "band at 0.4 times the rate. Best are 2560, 2.56 times the 1000 Hz of ISO 20816-3. Or write another "
    'measure, e.g. measure = "rms" with limits of your own in g',
)
OK_LIMITS_TOO_NEAR = Code(
    "A19",
    "The sensor is not OK just above its setpoint",
    "Beyond ok_between a sensor counts as broken, and its alarms are suppressed. A machine that is about to "
    "fail may vibrate more than that.",
    "End ok_between where the sensor can measure no more, at 1.5 times the highest setpoint or beyond.",
    _PAGE,
    example="machine.toml:63: sensors[0].ok_between = [0.0, 5.0]: ends just above danger = 4.5 of alarm "
    '"de-vibration". If the machine vibrates more than 5 mm/s, the sensor counts as broken, and the alarm is '
    "suppressed. Remedy: ok_between is for what the sensor cannot measure, e.g. with a broken wire: end it "
    "at 6.8 mm/s or more",
)
