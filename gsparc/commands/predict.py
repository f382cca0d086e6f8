"""`gsparc predict ckpt=FILE places=FILE`: predictions at places in degrees or metres,
as a table.
"""

from __future__ import annotations

from gsparc.apps.maps.promise import read_promise
from gsparc.prediction.answer_files import predict_file
from gsparc.prediction.operating_point import load
from gsparc.runs.output import CommandCall, Result, command


@command()
def task(call: CommandCall) -> Result:
    """Predict at places of a table."""
    predictor = load(
        call.given["ckpt"], confidence=call.given["confidence"], unit=call.given["unit"]
    )
    if call.given["frequency_hz"] is not None:
        predictor = predictor.select_carrier(call.given["frequency_hz"])
    promise = read_promise(predictor.extra)
    facts = predict_file(
        predictor,
        call.given["places"],
        call.given["out"],
        station=None if call.given["station"] is None else str(call.given["station"]),
        columns=call.given["columns"],
        overwrite=bool(call.given["overwrite"]),
        tested=None if promise is None else promise.expected_errors,
    )
    before, stations = f"{facts['predict/places']} places", facts["predict/stations"]
    if stations:
        before += f", {stations} station{'s' * (stations > 1)}"
    # Powers alone have a lowest and a highest.
    ends = [
        value
        for name, value in facts.items()
        if name.startswith(("predict/lowest", "predict/highest"))
    ]
    if ends:
        before += f": {' to '.join(f'{end:.4g}' for end in ends)} {predictor.unit}"
    before += f", {empty} predictions empty" if (empty := facts["predict/empty"]) else ""
    before += f"; predictions in {facts['out']}"
    if promise is None and predictor.site.target.is_level:
        before += (
            "; deviations are the model's own: gsparc map ckpt=FILE tests them, then ask again"
        )
    before += "; summary "
    return Result(facts | {"ckpt": call.given["ckpt"]}, before=before)
