from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Optional as _Optional

DESCRIPTOR: _descriptor.FileDescriptor

class SampleBlock(_message.Message):
    __slots__ = ("at_ns", "first_index", "t_first_ns", "period_ns", "lost_before", "quality", "t_error_ns", "pause_before", "channels", "samples")
    AT_NS_FIELD_NUMBER: _ClassVar[int]
    FIRST_INDEX_FIELD_NUMBER: _ClassVar[int]
    T_FIRST_NS_FIELD_NUMBER: _ClassVar[int]
    PERIOD_NS_FIELD_NUMBER: _ClassVar[int]
    LOST_BEFORE_FIELD_NUMBER: _ClassVar[int]
    QUALITY_FIELD_NUMBER: _ClassVar[int]
    T_ERROR_NS_FIELD_NUMBER: _ClassVar[int]
    PAUSE_BEFORE_FIELD_NUMBER: _ClassVar[int]
    CHANNELS_FIELD_NUMBER: _ClassVar[int]
    SAMPLES_FIELD_NUMBER: _ClassVar[int]
    at_ns: int
    first_index: int
    t_first_ns: int
    period_ns: float
    lost_before: int
    quality: int
    t_error_ns: float
    pause_before: int
    channels: int
    samples: bytes
    def __init__(self, at_ns: _Optional[int] = ..., first_index: _Optional[int] = ..., t_first_ns: _Optional[int] = ..., period_ns: _Optional[float] = ..., lost_before: _Optional[int] = ..., quality: _Optional[int] = ..., t_error_ns: _Optional[float] = ..., pause_before: _Optional[int] = ..., channels: _Optional[int] = ..., samples: _Optional[bytes] = ...) -> None: ...
