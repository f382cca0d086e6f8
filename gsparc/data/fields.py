"""The names of the schema for measurements of one's own; docs/own-data.md is the same table."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Field:
    """One array of a file.

    Attributes:
        name: of the array.
        shape: allowed; S samples, K frequencies, A antennas, T stations, H x W pixels, P paths, I sources.
        unit: required value of `units` where given.
        required: `yes`, `one of`, or when.
        meaning: in words.
    """

    name: str
    shape: str
    unit: str
    required: str
    meaning: str


FIELDS: dict[str, Field] = {
    field.name: field
    for field in [
        Field("rx_position", "(3,), (S, 3), (2,) or (S, 2)", "m", "yes", "where the receiver stood"),
        Field("tx_position", "(3,), (S, 3), (2,) or (S, 2)", "m", "yes", "where the transmitter stood"),
        Field("rx_height", "() or (S,)", "m", "with 2-D", "height of receivers of two coordinates"),
        Field("tx_height", "() or (S,)", "m", "with 2-D", "height of transmitters of two coordinates"),
        Field("station_position", "(T, 3) or (T, 2)", "m", "no", "several static ends; instead of one end"),
        Field("station_height", "() or (T,)", "m", "with 2-D", "height of stations of two coordinates"),
        Field("latitude", "(S,)", "deg", "no", "of the end that moves, instead of its position"),
        Field("longitude", "(S,)", "deg", "no", "east is positive; together with latitude"),
        Field("station_latitude", "(T,)", "deg", "no", "of stations, instead of station_position"),
        Field("station_longitude", "(T,)", "deg", "no", "together with station_latitude"),
        Field("station_name", "(T,)", "1", "no", "what you call each station"),
        Field("station_orientation", "(T, 4)", "1", "no", "quaternions (w, x, y, z) of receiving stations"),
        Field("station", "(S,)", "1", "no", "which station each row is of, from 0; else a column for each"),
        Field("sensitivity_db", "() or (T,)", "dB", "no", "level below which nothing is heard: NaN is that"),
        Field("run", "(S,)", "1", "no", "name or number; channels of a run share an unknown factor"),
        Field("time_s", "(S,)", "s", "no", "when each row was measured; kept, not read"),
        Field("spectrum", "(S, H, W)", "1", "one of", "power by direction, linear; or uint8 with 255 = 1"),
        Field("csi", "(S,), (S, K) or (S, A, K)", "1", "one of", "complex channel; (S, T, ...) of stations"),
        Field("rssi", "(S,) or (S, T)", "W", "one of", "received power, linear"),
        Field("rssi_db", "(S,) or (S, T)", "dB", "one of", "received power in dB or dBm"),
        Field("frequency_hz", "() or (K,)", "Hz", "with csi", "frequency of each subcarrier"),
        Field("carrier_hz", "(), (T,) or (S,)", "Hz", "no", "carrier; else the mean of frequency_hz"),
        Field("rx_orientation", "(4,) or (S, 4)", "1", "no", "quaternion (w, x, y, z), receiver to world"),
        Field("rx_rotation", "(3, 3) or (S, 3, 3)", "1", "no", "the same as a matrix; give one of the two"),
        Field("array_position", "(A, 3)", "m", "no", "receive antennas in the receiver's frame"),
        Field("grid_deg", "(4,)", "deg", "no", "first elevation, first azimuth, their steps"),
        Field("mask", "as the measurement", "1", "no", "True where measured; the rest may hold anything"),
        Field("noise_variance", "() or (S,)", "unit of the measurement squared", "no", "noise power"),
        Field("path_offsets", "(S + 1,)", "1", "no", "paths of sample i are path_offsets[i]:[i + 1]"),
        Field("path_direction", "(P, 3)", "1", "no", "direction of arrival, receiver's frame"),
        Field("path_last_point", "(P, 3)", "m", "no", "last interaction point; instead of path_direction"),
        Field("path_gain", "(P,) or (P, K)", "1", "no", "complex gain; K: frequency or polarisation"),
        Field("path_delay", "(P,)", "s", "no", "delay of each path; then path_gain is without carrier phase"),
        Field("path_mechanisms", "(P,)", "1", "no", "bits of what happened, named in attributes"),
        Field("path_order", "(P,)", "1", "no", "number of interactions of each path"),
        Field("received_power", "(S,)", "1", "no", "truth of a simulation: sum of path powers"),
        Field("delay_spread", "(S,)", "s", "no", "truth of a simulation: root mean square"),
        Field("spectrum_peak", "(S,)", "1", "no", "what each spectrum was divided by"),
        Field("spectrum_array_position", "(A, 3)", "m", "no", "array of a simulated file's spectrum"),
        Field("csi_array_position", "(A, 3)", "m", "no", "array of a simulated file's csi"),
        Field("csi_noise_variance", "()", "1", "no", "noise power of a simulated file's csi"),
        Field("line_of_sight", "(S,)", "1", "no", "True where nothing stood between"),
        Field("source_position", "(I, 3)", "m", "no", "truth of a simulation: where each source is"),
        Field("source_gain", "(I,)", "1", "no", "truth of a simulation: complex amplitude at 1 m"),
        Field("source_order", "(I,)", "1", "no", "truth of a simulation: reflections of each source"),
        Field("source_visible", "(S, I)", "1", "no", "truth of a simulation: visibility of each source"),
        Field("split_train", "(n,)", "1", "no", "rows to train on, from 0; together with split_test"),
        Field("split_test", "(n,)", "1", "no", "rows to test on, from 0"),
        Field("row_name", "(S,)", "1", "no", "what you call each row; used in messages"),
    ]
}

MEASUREMENTS = ("spectrum", "csi", "rssi", "rssi_db")
NORMALISATIONS = ("max", "minmax", "power", "none")
