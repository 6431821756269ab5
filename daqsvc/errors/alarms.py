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
)
VOTE = Code(
    "A02",
    "The vote cannot be reached",
    "More sensors are asked for than there are, or sensors of different units would share one setpoint.",
    "Write a smaller vote, or add sensors of one unit.",
    _PAGE,
)
NO_SETPOINT = Code(
    "A03",
    "The alarm has no setpoint",
    "Without alert and danger the alarm would never come.",
    "Add alert, danger or both.",
    _PAGE,
)
SETPOINT_ORDER = Code(
    "A04",
    "The setpoints are in the wrong order",
    "alert comes before danger: upper setpoints rise towards danger, lower ones fall. Setpoints beside "
    "zones keep to the order of the zones.",
    "Swap the two, or correct one.",
    _PAGE,
)
UNFIT_SETPOINT = Code(
    "A05",
    "The setpoint does not go with the measure",
    "Most measures are never negative and have upper setpoints only. A phase has a reference, and "
    "amplitudes may have a phase.",
    "Remove the key, or take a measure that it goes with.",
    _PAGE,
)
NEVER_REACHED = Code(
    "A06",
    "The setpoint is never reached",
    "The value is not believed there, the channel cannot carry it, or the stator does not let the shaft "
    "move as far.",
    "Correct the setpoint, or the limits of the sensor.",
    _PAGE,
)
DEADBAND = Code(
    "A07",
    "The alarm would never return",
    "An alarm returns when the value is back by the deadband. This one is as wide as the setpoint or the "
    "room between.",
    "Write a smaller deadband, e.g. a twentieth of the setpoint.",
    _PAGE,
)
UNFIT_MEASURE = Code(
    "A08",
    "The measure does not go with the sensor",
    "Velocities come from accelerometers and velocity sensors, gaps from proximity probes, values from "
    "sensors that send a level.",
    "Write the measure that the message names, or correct the type of the sensor.",
    _PAGE,
)
NOT_MEASURED = Code(
    "A09",
    "Nothing measures the level",
    "An alarm on the level of a sensor needs a detector that measures it.",
    "Write a table [pipeline.levels]; it may be empty.",
    _PAGE,
)
NO_REFERENCE = Code(
    "A10",
    "The reference of the phase is missing",
    "Setpoints of a phase are how far it may be from that of the machine in good order.",
    "Add reference_deg, the phase that was measured then.",
    _PAGE,
)
TRIP_MULTIPLY = Code(
    "A11",
    "trip_multiply has no use here",
    "It raises alert and danger while the machine starts up. That needs [alarm_handling.start_up] and "
    "setpoints above 0.",
    "Add what is missing, or remove trip_multiply.",
    _PAGE,
)
ALWAYS_STARTING = Code(
    "A12",
    "The machine would always be starting up",
    "The range of start_up holds the nominal speed.",
    "End the range below machine.speed_rpm.",
    _PAGE,
)
SILENT_DETECTOR = Code(
    "A13",
    "The detector would never raise the alarm",
    "The alarm follows a detector that is not configured, or that gives probabilities only.",
    "Write the table of the detector, correct its rule, or remove the alarm.",
    _PAGE,
)
UNFIT_ZONES = Code(
    "A14",
    "The zones do not go with the sensor or the measure",
    "Zones of ISO 20816-3 are of the velocity of a housing, by group and support, or of the displacement "
    "of a shaft.",
    "Write the zones that go with the sensor, or setpoints in place of them.",
    _PAGE,
)
NOT_OF_STANDARD = Code(
    "A15",
    "The measure is not that of the standards",
    "Limits of shaft vibration in ISO 20816 and API 670 are from peak to peak, which is about twice the "
    "peak value.",
    'Write measure = "peak_to_peak", with setpoints from peak to peak.',
    _PAGE,
)
CANNOT_JUDGE = Code(
    "A16",
    "An alarm cannot be judged",
    "The detector that the alarm follows does not give its measure.",
    "Correct the measure of the alarm. The message lists those that there are.",
    _PAGE,
    "alarm housing cannot be judged: levels measures rms, peak, not 'crest'; correct the alarm's measure",
)
