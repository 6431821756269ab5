"""What people of the trade call the keys of a machine file: words of other tools, manuals and standards."""

from __future__ import annotations

from difflib import get_close_matches
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

# Words by the keys that they may mean; the first key that a table takes is suggested.
_WORDS: Mapping[tuple[str, ...], str] = {
    ("baud", "bitrate"): "baudrate baud_rate bit_rate bitrate baud bps line_speed",
    ("data_bitrate",): "dbitrate data_baud data_baudrate fd_bitrate fast_bitrate",
    ("rate_hz",): (
        "fs f_s sample_rate samplerate sampling_rate sampling_frequency sample_frequency samples_per_second "
        "frequency frequency_hz freq rate odr sps fs_hz sample_rate_hz sampling_rate_hz"
    ),
    ("tcp_port", "port", "serial_port"): "port tcp_port portnumber port_number",
    (
        "serial_port",
        "port",
        "channel",
    ): "device dev tty com com_port comport serial serial_device",
    ("host", "url"): "ip ip_address ipaddress hostname server remote address broker broker_url uri gateway",
    ("unit",): "slave slave_id slaveid unit_id unitid unit_address device_id station node units",
    ("address", "place"): "register reg start register_address start_address first_register address offset",
    ("id", "stream_id"): "can_id canid arbitration_id frame_id cob_id message_id msg_id identifier",
    ("length", "payload_length"): "dlc size bytes len frame_length payload payload_size",
    ("byte_order", "order"): "endian endianness byteorder byte_ordering word_order wordorder",
    ("type",): "datatype data_type dtype kind format sensor_type model bearing bearing_type designation",
    ("scale",): "gain factor multiplier slope resolution lsb scaling m coefficient",
    ("offset", "zero_v"): "bias intercept zero b shift bias_v offset_v zero_voltage",
    ("sensitivity_mv_per_unit",): "sensitivity mv_per_unit mv_per_um mv_per_g mv_per_mil sens scale_factor",
    ("angle_deg",): "orientation angle direction mounting_angle probe_angle",
    ("gap_ok_v",): "gap_ok gap_limits ok_limits gap_range",
    ("ok_between",): "ok_limits range valid_range ok_range limits",
    ("threshold_v",): "threshold trigger_level trigger_v level",
    ("hysteresis_v", "deadband"): "hysteresis hyst dead_band deadband",
    ("edge",): "slope polarity trigger_edge",
    ("separator",): "sep delimiter field_separator column_separator delim field_delimiter",
    ("delimiter",): "terminator eol line_ending line_end newline end_of_line line_terminator",
    ("line",): "fields columns column_names header",
    ("columns",): "fields channels",
    ("signals",): "signal signal_names",
    ("signal",): "signals name",
    ("message",): "msg message_name frame",
    ("dbc",): "dbc_file database file dbcfile",
    ("flow_control",): "flow rtscts xonxoff flowcontrol handshake",
    ("stop_bits",): "stopbits stop",
    ("data_bits",): "databits bytesize byte_size",
    ("timeout_ms",): "timeout timeout_s response_timeout",
    ("poll_ms",): "poll_interval interval period scan_rate poll_rate cycle_time",
    ("framing",): "protocol frame frame_format",
    ("transport",): "mode protocol type",
    ("way",): "method mode function",
    ("table",): "function function_code register_type area",
    ("alert",): "warning warn high hi limit setpoint alarm a alert_high upper alarm1 pre_alarm",
    ("danger",): "trip critical hihi high_high shutdown alarm danger_high alarm2 d",
    ("alert_low",): "low lo warning_low lower low_limit",
    ("danger_low",): "lolo low_low critical_low trip_low",
    ("on_delay_s",): "delay on_delay time_delay alarm_delay delay_s",
    ("off_delay_s",): "off_delay reset_delay return_delay",
    ("latching",): "latch latched manual_reset",
    ("measure",): "quantity metric statistic parameter",
    ("trip_multiply",): "trip_multiplier setpoint_multiplier multiply",
    ("username",): "user login user_name",
    ("client_id",): "clientid id",
    ("keepalive_s",): "keep_alive keepalive",
    ("topic_root",): "topic topic_prefix prefix base_topic",
    ("ca_file",): "ca cafile ca_cert ca_certs cacert tls_ca",
    ("cert_file",): "cert certificate certfile client_cert",
    ("key_file",): "key keyfile private_key client_key",
    ("protocol",): "version mqtt_version",
    ("directory",): "path folder dir location database",
    ("file",): "path filename recording log",
    ("folder",): "path directory dir",
    ("speed_rpm",): "rpm speed running_speed nominal_speed shaft_speed rated_speed",
    ("window_s",): "window period block_s block length_s averaging_time",
    ("ring_s",): "buffer buffer_s history_s history",
    ("velocity_band_hz",): "band band_hz filter frequency_band",
    ("natural_frequency_hz",): "f0 fn wn natural_frequency critical_speed resonance",
    ("damping_ratio",): "zeta damping xi d",
    ("clearance_um",): "clearance gap_um gap",
    ("bpfi",): "inner_race inner",
    ("bpfo",): "outer_race outer",
    ("bsf",): "ball roller",
    ("ftf",): "cage",
    ("samples_per_frame",): "samples nsamples samples_per_message frame_samples",
    ("counts",): "mode unit",
    ("bits",): "width size bit",
    ("byte",): "position start_byte first_byte offset",
    ("start",): "on_start if_absent",
    ("listen",): "port address bind host",
}
_KEYS: dict[str, tuple[str, ...]] = {}
for _keys, _words in _WORDS.items():
    for _word in _words.split():
        _KEYS[_word] = (*_KEYS.get(_word, ()), *_keys)


def meant_key(word: str, free: Collection[str]) -> str | None:
    """The key that somebody meant; None if nothing comes near.

    Args:
        word: a key that is not known.
        free: the keys that could be in its place.
    """
    plain = word.lower().replace("-", "_").replace(" ", "_")
    if plain in free:
        return plain
    several = next((name for name in free if name in {f"{plain}s", f"{plain}es"}), None)
    if several is not None:
        return several
    called = next((name for name in _KEYS.get(plain, ()) if name in free), None)
    if called is not None:
        return called
    with_unit = [name for name in free if name.startswith(f"{plain}_")]
    if with_unit:
        return with_unit[0]
    close = get_close_matches(plain, free, n=1, cutoff=0.7)
    if close:
        return close[0]
    # A slip of the pen in a word of the trade: "samplin_rate".
    words = [name for name in _KEYS if any(key in free for key in _KEYS[name])]
    nearly = get_close_matches(plain, words, n=1, cutoff=0.85)
    return next((name for name in _KEYS[nearly[0]] if name in free), None) if nearly else None
