"""Tables as strangers make them, with what `gsparc check` must say of each."""

import numpy as np

ROWS = 240
RNG = np.random.default_rng(3)
PLACES = np.round(np.c_[RNG.uniform(0, 60, ROWS), RNG.uniform(0, 40, ROWS)], 2)
AT = np.array([[5.0, 5], [55, 8], [10, 35]])
AWAY = np.linalg.norm(PLACES[:, None] - AT, axis=2)
LEVELS = np.round(-40 - 25 * np.log10(np.maximum(AWAY, 1)) + RNG.normal(0, 2, AWAY.shape))
NORTH, EAST = 48.2 + PLACES[:, 1] / 1.1e4, 16.37 + PLACES[:, 0] / 7.4e3
DEAF = np.quantile(LEVELS, 0.6) > LEVELS


def table(heads: str, *columns) -> str:
    lines = [",".join(map(str, row)) for row in zip(*columns, strict=True)]
    return "\n".join([heads, *lines]) + "\n"


def wide(mark) -> str:
    cells = np.where(DEAF, str(mark), LEVELS.astype(int).astype(str))
    return table("x,y,AP1,AP2,AP3", *PLACES.T, *cells.T)


def long(heads: str, *more, level=LEVELS[:, 0], places=PLACES) -> str:
    return table(f"x,y,rssi,{heads}", *places.T, level, *more)


FLOOR = RNG.integers(0, 3, ROWS)
BAND = RNG.integers(0, 2, ROWS)
FIFTH, NINTH = np.arange(ROWS) == 4, np.arange(ROWS) % 9 == 4
ZERO = np.where(np.arange(ROWS)[:, None] < 12, 0, np.c_[NORTH, EAST])


MINUTES = (
    [f"{int(v)} {60 * (v % 1):.4f} N" for v in NORTH],
    [f"{int(v)}°{60 * (v % 1):.4f}'E" for v in EAST],
)
SECONDS = [  # in quotes, which a quotation mark doubles
    [f'"{int(v)}°{int(60 * (v % 1))}\'{3600 * v % 60:.2f}""{end}"' for v in axis]
    for axis, end in ((NORTH, "N"), (EAST, "E"))
]
NMEA = [100 * int(v) + 60 * (v % 1) for v in NORTH], [100 * int(v) + 60 * (v % 1) for v in EAST]
ZONES = PLACES + np.where(np.arange(ROWS)[:, None] < 80, [700_000, 5e6], [300_000, 5e6])
WAY = np.c_[np.linspace(0, 60, ROWS), np.full(ROWS, 9.0)]
ALONG = np.round(-30 - 70 * np.log10(1 + 0.3 * WAY[:, 0]), 1)
STUCK = np.where((np.arange(ROWS)[:, None] > 60) & (np.arange(ROWS)[:, None] < 180), WAY[61], WAY)

DROPS = [-50 - np.arange(ROWS) % 3 - 40 * (np.arange(ROWS) == 100 + i) for i in range(12)]

# Places in one cell each, as databases, maps and notebooks write them.
ONE_CELL = {
    "well-known text": [f"POINT Z ({e:.6f} {n:.6f} 3)" for n, e in zip(NORTH, EAST, strict=True)],
    "a GeoJSON text": [
        f'"{{""type"": ""Point"", ""coordinates"": [{e:.6f}, {n:.6f}]}}"'
        for n, e in zip(NORTH, EAST, strict=True)
    ],
    "a pair": [f'"{n:.6f}, {e:.6f}"' for n, e in zip(NORTH, EAST, strict=True)],
    "a record": [
        f"\"{{'lat': {n:.6f}, 'lng': {e:.6f}}}\"" for n, e in zip(NORTH, EAST, strict=True)
    ],
}

# name: content, settings, what `check` must say, what it must not.
CASES = {
    "a mark far below": (
        wide(-999),
        {},
        "exactly -999, apart from all others: taken as not heard",
        "",
    ),
    "a mark beyond any level": (
        wide(100000),
        {},
        "394 of 720 levels are exactly 100000",
        "refused",
    ),
    "a text": (
        wide("No Service"),
        {},
        "394 of 720 levels are 'No Service': taken as not heard",
        "refused",
    ),
    "no power": (wide("-inf"), {}, "394 of 720 powers were not heard", "refused"),
    "a mark that is none": (
        wide(100),
        {"not_heard": []},
        "394 of 720 levels are exactly 100, the most: a receiver in saturation?",
        "taken as not heard",
    ),
    "no fix": (
        table("lat,lon,rssi", *ZERO.T, LEVELS[:, 0]),
        {},
        "lines 2 to 13: latitude and longitude are 0",
        "",
    ),
    "a place beyond the pole": (
        table("lat,lon,rssi", np.where(FIFTH, 95, NORTH), EAST, LEVELS[:, 0]),
        {},
        "line 6: no such place on Earth",
        "refused",
    ),
    "a place beyond all": (
        table("x,y,rssi", np.where(FIFTH, 1e30, EAST), NORTH, LEVELS[:, 0]),
        {},
        "line 6: no such place on Earth",
        "refused",
    ),
    "a mark for no fix": (
        table("lat,lon,rssi", *np.where(NINTH, [[91], [181]], [NORTH, EAST]), LEVELS[:, 0]),
        {},
        "no such place on Earth",
        "refused",
    ),
    "a fix that stands still": (
        table("x,y,rssi", *STUCK.T, ALONG),
        {},
        "line 63 to line 181: one place for 119 rows, while levels",
        "",
    ),
    "minutes": (
        table("lat,lon,rssi", *MINUTES, LEVELS[:, 0]),
        {},
        "north of latitude 48.2,",
        "refused",
    ),
    "NMEA": (
        table("lat,lon,rssi", *NMEA, LEVELS[:, 0]),
        {},
        "as NMEA writes them (ddmm.mmmm)",
        "more rows",
    ),
    "ten millionths": (
        table("lat,lon,rssi", *(np.c_[NORTH, EAST] * 1e7).astype(int).T, LEVELS[:, 0]),
        {},
        "times ten million",
        "",
    ),
    "degrees in metres": (
        table("LAT,LON,rssi", *(PLACES + np.array([5e6, 4e5])).T, LEVELS[:, 0]),
        {},
        "dataset.columns.x=LON dataset.columns.y=LAT",
        "",
    ),
    "two zones": (
        long("grid", np.where(np.arange(ROWS) < 80, "32T", "33T"), places=ZONES),
        {},
        "two groups of places 399.9 km apart",
        "millimetres",
    ),
    "floors": (
        long("Storey", FLOOR, level=LEVELS[:, 0] - 15 * FLOOR),
        {},
        "dataset.columns.z=Storey*3.2",
        "",
    ),
    "a floor of 3.2 m": (
        long("floor", FLOOR),
        {"columns": {"z": "floor*3.2"}},
        "x 6.40 m",
        "warning",
    ),
    "a flight in feet": (
        table(
            "lat,lon,rssi,height_above_takeoff(feet)",
            NORTH,
            EAST,
            LEVELS[:, 0],
            RNG.uniform(30, 160, ROWS),
        ),
        {},
        "feet turned into m",
        "",
    ),
    "an area and a cell": (
        long("cell_id,tac", 7 + 0 * BAND, BAND),
        {},
        "2 stations, 2 of them at unknown places: 7 1, 7 0",
        "",
    ),
    "a confidence interval": (long("CI", 7 + BAND), {}, "stays       the transmitter", "stations"),
    "columns that are said": (
        long("site,antenna", 7 + 0 * BAND, BAND),
        {"columns": {"station": "site+antenna"}},
        "2 stations, 2 of",
        "",
    ),
    "streets of one cell": (
        long("site,street", "a" * ROWS, np.digitize(PLACES[:, 0], [15, 30, 45])),
        {},
        "1 station,",
        "warning",
    ),
    "hopping": (
        long("gateway,freq_mhz", ["g"] * ROWS, RNG.choice([867.1, 868.1, 868.5], ROWS)),
        {},
        "1 station,",
        "warning",
    ),
    "a banner with a role in it": (
        "WigleWifi-1.6,model=x,device=x,display=kismet\n"
        + table(
            "MAC,Frequency,RSSI,CurrentLatitude,CurrentLongitude",
            "a" * ROWS,
            [2412] * ROWS,
            LEVELS[:, 0],
            NORTH,
            EAST,
        ),
        {},
        "2.412 GHz",
        "refused",
    ),
    "a title above repeated heads": (
        wide("") + "Table 2\n" + wide(""),
        {},
        "lines 242 to 243: the heads again",
        "refused",
    ),
    "heads of another table": (
        wide("") + long("BSSID", BAND),
        {},
        "line 242: heads of another table than that of line 1",
        "more rows",
    ),
    "a quality": (
        table("x,y,quality", *PLACES.T, LEVELS[:, 0] + 110),
        {},
        "'quality' is a quality, not a level",
        "",
    ),
    "arbitrary strength units": (
        table("x,y,asu", *PLACES.T, LEVELS[:, 0] + 140),
        {},
        "'asu' is ASU, of LTE? say dataset.columns.rssi_db=asu-140",
        "GSM",
    ),
    "strength units of GSM": (
        table("x,y,asu", *PLACES.T, np.where(NINTH, 99, (LEVELS[:, 0] + 98) // 2)),
        {},
        "of GSM (times 2) or LTE? say dataset.columns.rssi_db=asu*2-113",
        "saturat",
    ),
    "units that are said": (
        table("x,y,asu", *PLACES.T, LEVELS[:, 0] + 140),
        {"columns": {"rssi_db": "asu-140"}},
        "good",
        "warning",
    ),
    "joined files": (wide("") + wide(""), {}, "line 242: the heads again; left out", "refused"),
    "units in cells": (
        long("t", range(ROWS), level=[f"{v} dBm" for v in LEVELS[:, 0]]),
        {},
        "good",
        "refused",
    ),
    "per cent in cells": (
        long("t", range(ROWS), level=[f"{v + 110}%" for v in LEVELS[:, 0]]),
        {},
        "a quality, not a level",
        "more rows",
    ),
    "losses": (
        table("x,y,path_loss", *PLACES.T, -LEVELS[:, 0]),
        {},
        "'path_loss' are losses? say dataset.columns.rssi_db=path_loss*-1",
        "",
    ),
    "losses that are said": (
        table("x,y,path_loss", *PLACES.T, -LEVELS[:, 0]),
        {"columns": {"rssi_db": "path_loss*-1"}},
        "good",
        "warning",
    ),
    "a typesetter's minus": (
        long("BSSID", BAND, level=[f"−{-v:.0f}" for v in LEVELS[:, 0]]),
        {},
        "2 stations",
        "refused",
    ),
    "networks beside addresses": (
        table(
            'X,Y,02:00:00:00:00:a1;office,"02:00:00:00:00:b1;guest, floor 2"',
            *PLACES.T,
            *LEVELS[:, :2].T,
        ),
        {},
        "2 stations",
        "refused",
    ),
    "one cell on two carriers": (
        long("EARFCN,PCI", 1300 + 100 * BAND, [101] * ROWS),
        {},
        "2 stations",
        "",
    ),
    "seconds": (
        table("lat,lon,rssi", *SECONDS, LEVELS[:, 0]),
        {},
        "north of latitude 48.2,",
        "refused",
    ),
    "a gateway without a fix": (
        table(
            "lat,lon,gateway,gateway_lat,gateway_lon,rssi",
            NORTH,
            EAST,
            np.where(BAND, "hill", "roof"),
            48.21 * BAND,
            16.38 * BAND,
            LEVELS[:, 0],
        ),
        {},
        "roof: no fix",
        "",
    ),
    "many of a kind": (
        table(",".join(["x", "y", *(f"AP{i}" for i in range(12))]), *PLACES.T, *DROPS),
        {},
        "(and 11 more warnings of this kind)",
        "station AP7",
    ),
}
