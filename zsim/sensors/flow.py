"""The optical flow: velocity over the ground, by the camera that looks down."""

from zsim.schema.message import Number, Vector3
from zsim.sensors.sensor import Channel, ErrorModel, Sample, Sensor, SensorType


class Flow(Sample, frozen=True):
    """Velocity over the ground in the heading frame [m/s], and in [0, 1] how much of the picture is ground."""

    velocity_m_s: Vector3
    quality: Number


class FlowConfig(Sensor, frozen=True, kw_only=True):
    velocity_m_s: ErrorModel = ErrorModel()


FLOW_PRESET = {
    "rate_hz": 15.0,  # Hz, of the reduced navdata in which the drone sends its velocity
    "velocity_m_s": {"noise": 0.1},  # m/s, chosen: nothing is published for the aircraft's flow
}
FLOW_PRESETS = {
    "ardrone2": FLOW_PRESET,
    "paper": FLOW_PRESET,  # it is silent
    "crazyflie2": {"rate_hz": 25.0, "velocity_m_s": {"noise": 0.1}},  # chosen; nothing is published for the deck
}

FLOW = SensorType(
    label="optical flow",
    message=Flow,
    settings=FlowConfig,
    channels=(Channel("velocity_m_s", "m/s", 3, axes="forward, left, up", bias_max=1e3),),
    exact=1,
    presets=FLOW_PRESETS,
)
