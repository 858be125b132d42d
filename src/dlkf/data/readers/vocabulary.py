"""Names of columns: what they mean in English, German, French, Spanish, Chinese and Japanese, and their unit.

Patterns are matched against the whole of a name's words (:func:`words`), without its unit; of several alternatives in a
list the first that a table has is taken.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Sequence
from itertools import chain

RECEIVERS = r"gps|gnss|loc(?:ation)?|rtk|ublox|nmea|receiver|nav|fix|pos(?: lla)?"
RECEIVER = rf"(?:(?:{RECEIVERS}) )?"
NORTH, EAST = r"n(?:orth|ord)?|lat(?:itude)?|norte?", r"e(?:ast)?|lon(?:gitude)?|ost|est|este"
DOWN, UP = r"d(?:own)?", r"u(?:p)?|alt(?:itude)?|h(?:eight)?"
ACCURACY = r"(?:acc(?:uracy)?|error|err|std|sigma|genauigkeit|fehler|precision|exactitud|incertitude|精度|误差|誤差)"
CARRIER = r"carr(?:ier)? ?soln?"
VELOCITY = r"v(?:el(?:ocity)?)?(?: ned)?|geschwindigkeit|vitesse|velocidad|速度"

SENSORS = {
    "accel": r"(?:(?:total|raw) )?(?:acc(?:el(?:eration|erometer|erometre)?)?|specific ?force|g ?force|force|f|a|fb"
    r"|accelerometer acceleration|beschl(?:eunigung(?:ssensor|smesser)?)?|acel(?:er(?:acion|ometro)?)?"
    r"|加速度(?:计|計|センサ|センサー)?)",
    "gyro": r"(?:raw )?(?:gyr?o?(?:s[ck]op(?:e|io)?|met(?:er|re))?|omega|w|g"
    r"|ang(?:le|ular)? ?(?:velocity|vel|rate|speed)|rate|(?:motion )?(?:rotation|turn) ?rate|gyro(?:scope)? rotation|wb"
    r"|drehrate|drehgeschwindigkeit|winkelgeschwindigkeit|kreisel|vitesse (?:angulaire|de rotation)"
    r"|giro(?:scopi?o|metro)?"
    r"|velocidad angular|角速度|陀螺仪?|陀螺儀|ジャイロ(?:センサー?)?)",
}
LINEAR = r"linear ?acc(?:el(?:eration)?)?"  # a phone's is without gravity, ROS' with it: beside a gyroscope alone
ANGLES = ("roll", "pitch", "yaw")
AXES = {
    axis: rf"(?:{axis}|(?:axis|achse|axe|eje) {axis}|{axis} ?(?:axis|achse|axe|eje|轴|軸)(?: ?方向)?)"
    for axis in (*"xyz012", *ANGLES)
}

ELLIPSOIDAL = [r"ell?ip\w*(?: (?:height|alt(?:itude)?|hoe?he))?|h ell|(?:alt(?:itude)?|height) wgs ?84"]
ELLIPSOIDAL += [r"(?:(?:h(?:eight)?|hgt|alt(?:itude)?) ?)?hae"]
ELLIPSOIDAL += [r"(?:height|alt(?:itud|itude|ura)?|hauteur|elevacion|hoe?he) ell?\w*|大地高|椭球高|橢球高|楕円体高"]
SEA_LEVEL = r"(?:h|height|alt(?:itude)?|ele\w*) ?(?:msl|amsl|asl)|h ?msl"
QUANTITIES: dict[str, list[str]] = {
    "lat": [r"lat(?:itude?)?", r"(?:geo\w* )?breite(?:ngrad)?", r"latitud|phi|纬度|緯度|北纬|北緯"],
    "lon": [r"lon(?:gitude?)?|lng|long", r"(?:geo\w* )?la?enge|(?:geo\w* )?lange|(?:laengen|langen)grad"]
    + [r"longitud|lambda|lam|经度|經度|経度|东经|東経"],
    "height": [*ELLIPSOIDAL]
    + [r"h|hgt|height|alt(?:itude)?|ele(?:v|vation)?|hoe?he(?: (?:uber|ueber) .*)?|hauteur|altitud|altura|elevacion"]
    + [r"高度|高程|海拔(?:高度)?|标高|標高|高さ", SEA_LEVEL],
    "geoid": [r"geoid(?: ?sep\w*| ?height| ?undulation)?|undulation|sep|geoidundulation|ondulation"]
    + [r"高程异常|ジオイド高?"],
    "north": [rf"(?:{VELOCITY}) ?(?:n(?:orth|ord)?|norte)|north(?:ward)? ?vel(?:ocity)?|北向速度|北向き速度"],
    "east": [rf"(?:{VELOCITY}) ?(?:e(?:ast)?|ost|este?)|east(?:ward)? ?vel(?:ocity)?|东向速度|東向き速度"],
    "down": [rf"(?:{VELOCITY}) ?(?:d(?:own)?|ab)|down(?:ward)? ?vel(?:ocity)?"],
    "up": [rf"(?:{VELOCITY}) ?(?:u(?:p)?|auf)|up(?:ward)? ?vel(?:ocity)?|climb|天向速度|上向き速度"],
    "speed": [r"(?:ground )?(?:speed|sog|g ?speed|velocity|spd|vel)|speed over ground|g ?s"]
    + [r"geschw(?:indigkeit)?|tempo|vitesse(?: sol)?|velocidad|rapidez|速度|地速|速率|対地速度|对地速度|速さ"],
    "course": [
        r"(?:true )?(?:course|cog|bearing|track|heading|direction|head ?mot)(?: over ground| true)?|course ?angle"
    ]
    + [r"(?:fahrt)?richtung|kurs(?: uber grund)?|cap(?: vrai)?|route|rumbo|curso|direccion"]
    + [r"航向角?|航迹角|方向角?|方位角?|针路|針路|进路|進路|進行方向", r"orientation"],
    "quality": [r"quality|(?:fix|gga|gps) ?quality|qualitat|qualitaet|qualite|calidad"]
    + [r"(?:定位|测位|測位)?(?:质量|品质|品質|質量)"]
    + [r"fix ?(?:typ|type|art|status|mode|qual)?|(?:gps ?)?status|(?:gps ?)?mode|sol(?:ution)?(?: ?(?:type|status))?"]
    + [CARRIER, r"pos(?:ition)? ?type"]
    + [r"rtk(?: ?(?:status|fix|mode|state))?|type de fix|tipo de fix|modo|(?:定位|测位|測位|解)(?:状态|狀態|状態)|q"],
    "hacc": [rf"h(?:or(?:izontal)?)? ?(?:pos(?:ition)? )?{ACCURACY}|eph|pos(?:ition)? ?{ACCURACY}"]
    + [rf"horizontale? ?{ACCURACY}|{ACCURACY} horizontale?|lagegenauigkeit|水平(?:位置)?(?:精度|误差|誤差)"]
    + [r"accuracy|genauigkeit|precision|exactitud|(?:位置)?精度|(?:位置)?误差|(?:位置)?誤差"],
    "vacc": [rf"v(?:ert(?:ical)?)? ?(?:pos(?:ition)? )?{ACCURACY}|epv|(?:alt(?:itude)?|height) ?{ACCURACY}"]
    + [rf"vertikale ?{ACCURACY}|verticale? ?{ACCURACY}|{ACCURACY} verticale?|ho?e?hengenauigkeit"]
    + [r"(?:垂直|高度|高程)(?:精度|误差|誤差)"],
    "sacc": [rf"s ?{ACCURACY}|(?:speed|vel(?:ocity)?) ?{ACCURACY}|eps|geschwindigkeitsgenauigkeit"]
    + [rf"{ACCURACY} (?:de )?(?:la )?(?:vitesse|velocidad)|速度(?:精度|误差|誤差)"],
    "hdop": [r"h ?dop|水平精度因子"],
    "vdop": [r"v ?dop"],
    "pdop": [r"p ?dop|dop"],
    "week": [r"week|wn|week ?(?:number|no|num)|woche|semaine|semana|周|星期|週番号|周数"],
}
for _kind, _stem in (("pos", r"(?: ?pos(?:ition)?)?"), ("vel", r" ?v(?:el(?:ocity)?)?")):
    for _axis, _names in (("n", NORTH), ("e", EAST), ("d", rf"{DOWN}|{UP}")):
        QUANTITIES[f"std_{_kind}_{_axis}"] = [rf"(?:std(?:dev)?|sd|sigma){_stem} ?(?:{_names})"]
for _axis, _names in (("n", "lat(?:itude)?|north"), ("e", "lon(?:gitude)?|east"), ("d", "alt(?:itude)?|height|down")):
    QUANTITIES[f"std_pos_{_axis}"].append(rf"(?:{_names}) {ACCURACY}")
    QUANTITIES[f"std_vel_{_axis}"].append(rf"vel(?:ocity)? (?:{_names}) {ACCURACY}")

WHEEL = r"\b(?:wheels?|obd2?|odo(?:meter)?|can|vehicle|car|ecu|rad\w*|tacho\w*|roues?|ruedas?|vehicule|vehiculo)\b"
WHEEL += r"|[车車轮輪]"
SPEEDS = (
    r"\b(?:speed|velocity|vel|v|geschw\w*|\w*geschwindigkeit|raddrehzahl|vitesse|velocidad|rpm|ticks?|counts?|pulses?"
)
SPEEDS += r"|impulse?|odo(?:meter)?|distance|weg)\b|速|オドメータ"
NO_WHEEL = r"\b(?:gps|gnss|diff\w*|average|avg|mean|max\w*|trip|engine|motor|fan|std|acc\w*|angle|steer\w*|time)\b"
COUNTED = r"\b(?:ticks?|counts?|pulses?|impulse?|odo(?:meter)?|distance|weg)\b"
REAR = r"\b(?:rl|rr|rear|hl|hr|hinten|arriere|trasera)\b|后|後"
HEADING = r"\b(?:hdt|ths|dual|baseline|relpos\w*|antennas?|moving ?base)\b"  # "true heading" is a phone's compass
COMPASS = r"\b(?:magn\w*|compass|kompass)\b"
PRESSURE = r"(?:baro(?:meter|metric)? ?)?(?:air ?)?(?:press(?:ure)?|luftdruck|druck|pression|presion|气压|氣壓|気圧)"
BARO_HEIGHT = r"baro(?:metric|meter)? ?(?:alt(?:itude)?|height)|relative ?altitude"

TIME = (
    r"#?(?:t|time|time ?stamps?|tow|sow|gps ?(?:time|sow|tow|seconds?|t)?|unix ?(?:time)?|posix(?: ?time)?|utc"
    r"|stamp|epoch|secs?|seconds|date ?time|milli(?:s|seconds)?"
    r"|micro(?:s|seconds)?|nano(?:s|seconds)?|ms|us|ns|ticks|sample ?time"
    r"|ros ?time|i ?tow|utc ?(?:time|seconds)|seconds ?elapsed|elapsed|sample ?time ?fine|date ?num"
    r"|(?:location|accelerometer|gyro|motion) timestamp since (?:1970|reboot)|time since start(?: in)?"
    r"|zeit(?:stempel|punkt)?|uhrzeit|temps|heure|horodatage|tiempo|hora"
    r"|marca de tiempo"
    r"|时间戳?|時間|时刻|時刻|タイムスタンプ)(?: (?:utc|gps|unix|local|lokal))*"
)
DATE = r"(?:(?:utc|gps|local|gnss) ?)?(?:date|datum|tag|jour|fecha|dia|日期|日付|年月日)(?: (?:utc|gps|local|lokal))?"
SECONDS = r"(?:s|secs?|seconds?)"
FRACTIONS = {"ns": rf"n(?:ano)? ?{SECONDS}", "us": rf"(?:u|micro) ?{SECONDS}", "ms": rf"(?:m|milli) ?{SECONDS}"}
SINCE_1970 = r"(?:location |gps |gnss )?time ?stamp since ?1970"  # of a fix itself, beside samples
CLOCKS = {"unix": r"\b(unix|posix|epoch|ros)\b", "gps": r"\b(gps|gpst|gnss|tow|sow|itow)\b", "utc": r"\butc\b"}

# units as words (brackets and signs gone): the quantity's unit as the mapping calls it
UNITS = {
    **dict.fromkeys(("kmh", "km h", "kph", "kmph", "公里 小时"), "km/h"),
    **dict.fromkeys(("mph", "mi h"), "mph"),
    **dict.fromkeys(
        ("kn", "kt", "kts", "knot", "knots", "noeuds", "nœuds", "knoten", "nudos", "节", "節", "ノット"), "knots"
    ),
    **dict.fromkeys(("m s", "mps", "ms 1", "m sec"), "m/s"),
    **dict.fromkeys(("m s2", "mps2", "m s 2", "ms2", "ms 2", "m s s"), "m/s2"),
    **dict.fromkeys(("mm s", "mmps"), "mm/s"),
    **dict.fromkeys(("cm s", "cmps"), "cm/s"),
    **dict.fromkeys(("rad s", "rps", "rads", "rad sec"), "rad/s"),
    **dict.fromkeys(("deg s", "dps", "grad s", "° s", "deg sec"), "deg/s"),
    **dict.fromkeys(("mdps", "mdeg s"), "mdeg/s"),
    **dict.fromkeys(("deg", "degree", "degrees", "grad", "°", "度"), "deg"),
    **{
        u: u for u in ["g", "mg", "rad", "m", "mm", "cm", "km", "ft", "s", "ms", "us", "ns", "pa", "hpa", "mbar", "rpm"]
    },
    **dict.fromkeys(("sec", "seconds", "sek", "秒"), "s"),
    **dict.fromkeys(("feet", "fuss"), "ft"),
    **dict.fromkeys(("meter", "metres", "meters", "米"), "m"),
    **dict.fromkeys(("毫秒", "msec", "millis"), "ms"),
    **dict.fromkeys(("c", "grad c", "% ", "percent"), ""),
}


# beyond ASCII, in the names and units of columns: a file's encoding shows by them
LETTERS = set().union(
    *SENSORS.values(), *AXES.values(), *chain(*QUANTITIES.values()), TIME, DATE, WHEEL, SPEEDS, *UNITS
)
LETTERS = {x for x in LETTERS.union(PRESSURE) if not x.isascii()}
LETTERS |= set("äöüÄÖÜßéèêàâçîôûñóíáúÉÈÀÓÍÁÚ²³°µμ·±") | set("卫星数温磁场角设备名称年月日無効固定解浮点单差分")


def words(name: str) -> str:
    """``Accel X [m/s^2]`` → ``accel x``; ``accX`` → ``acc x``; ``vel_n_mps`` → ``vel n``; ``Länge (°)`` → ``lange``."""
    return split_unit(name)[0]


def find_unit(name: str) -> str | None:
    """The unit that a name ends in or has in brackets, as the mapping calls it; None where it states none."""
    return split_unit(name)[1]


def split_unit(name: str) -> tuple[str, str | None]:
    """The words of a name, and its unit."""
    in_brackets = re.findall(r"[\[(（【](.*?)[\])）】]", name)
    bare = _plain(re.sub(r"[\[(（【].*?[\])）】]", " ", name))
    for text in in_brackets:
        if (unit := UNITS.get(_plain(text))) is not None:
            return bare, unit
    parts = bare.split()
    for count in (3, 2, 1):  # the longest that leaves something
        if len(parts) > count and (unit := UNITS.get(" ".join(parts[-count:]))) is not None:
            return " ".join(parts[:-count]), unit
    return bare, None


def _plain(text: str) -> str:
    """Words in small letters, accents of Latin letters gone, full-width letters as usual ones."""
    spaced = re.sub(r"([a-z0-9à-ÿ])([A-Z])", r"\1 \2", text.replace("ß", "ss").replace("µ", "u").replace("μ", "u"))
    letters = []
    for letter in unicodedata.normalize("NFKC", spaced):
        first = unicodedata.normalize("NFD", letter)[0]
        letters.append(first if first.isascii() else letter)
    return re.sub(r"[^\w#°]+|_", " ", "".join(letters).lower()).strip()


def find_column(names: Iterable[str], key: str) -> str | None:
    """The column of a quantity: by its patterns in their order, the first column of several."""
    bare = [(name, words(name)) for name in names]
    for pattern in QUANTITIES[key]:
        for name, said in bare:
            if re.fullmatch(rf"{RECEIVER}(?:{pattern})", said):
                return name
    return None


def find_receiver(name: str) -> str:
    """The receiver that a name begins with (``rtk`` of ``rtk_lat``) or has in brackets; empty where it has none."""
    if begins := re.match(rf"({RECEIVERS}) \w", words(name)):
        return begins[1]
    in_brackets = re.search(r"[\[(](gps|gnss)[\])]", name, re.IGNORECASE)
    return in_brackets[1].lower() if in_brackets else ""


def is_ellipsoidal(name: str) -> bool:
    """Whether a height's name says that it is above the ellipsoid."""
    return any(re.fullmatch(f"{RECEIVER}(?:{pattern})", words(name)) for pattern in ELLIPSOIDAL)


def is_wheel(name: str) -> bool:
    """Whether a name says that a speed is that of a wheel or of the car's bus, and of no receiver."""
    return not find_receiver(name) and has(re.sub(r"[()\[\]]", " ", name), WHEEL)


def match_columns(names: Iterable[str], pattern: str) -> list[str]:
    """The columns whose words are all of a pattern."""
    return [name for name in names if re.fullmatch(pattern, words(name)) or re.fullmatch(pattern, _plain(name))]


def find_fraction(name: str) -> str | None:
    """The unit of a column with what another one lacks of the seconds, by its last word: ``nsecs``, ``micros``."""
    return next((unit for unit, said in FRACTIONS.items() if re.search(rf"\b{said}$", _plain(name))), None)


def find_seconds(names: Iterable[str]) -> tuple[str, str] | None:
    """Seconds and the rest of them in two columns: ``stamp.secs``, ``stamp.nsecs``; None where there are none."""
    bare = {_plain(name): name for name in names}
    for said, name in bare.items():
        if (unit := find_fraction(name)) is not None:
            before = re.sub(rf"\b{FRACTIONS[unit]}$", "", said)
            if whole := next((n for w, n in bare.items() if re.fullmatch(f"{re.escape(before)}{SECONDS}", w)), None):
                return whole, name
    return None


def find_triads(names: Sequence[str]) -> dict[str, list[str]]:
    """The columns of the accelerometer and of the gyroscope, of those that a table has.

    ``roll_rate``, ``pitch_rate``, ``yaw_rate`` are a gyroscope too, ``linear_acceleration.x`` is an accelerometer
    beside one.
    """
    accel, gyro = triad(names, SENSORS["accel"]), triad(names, SENSORS["gyro"])
    gyro = gyro or triad(names, SENSORS["gyro"], (ANGLES,))
    accel = accel or (triad(names, LINEAR) if gyro else None)
    return {key: columns for key, columns in (("accel", accel), ("gyro", gyro)) if columns}


def triad(names: Sequence[str], stem: str, triples: Sequence[Sequence[str]] = ("xyz", "012")) -> list[str] | None:
    """Three columns of one sensor: ``acc_x``, ``accX``, ``x_acc``, ``加速度X轴``, ``Beschleunigung X-Achse``."""
    bare = [(name, words(name)) for name in names]
    for axes in triples:
        found = []
        for axis in axes:
            both = rf"(?:(?:imu|field|data|msg) )*(?:{stem} ?{AXES[axis]}|{AXES[axis]} ?{stem})(?: ?(?:wert|value))?"
            found.append(next((name for name, said in bare if re.fullmatch(both, said)), None))
        if all(found):
            return [str(f) for f in found]
    return None


def wheel_columns(names: Iterable[str], called: str) -> list[str]:
    """The columns of a wheel's speed or counts, of the rear axle where several are named; ``called`` is the table's
    name, which counts where a column is plainly a speed."""
    by_table = has(called, WHEEL) or has(called, r"^speed$")
    found = []
    for name in names:
        bare = _plain(re.sub(r"[()\[\]]", " ", name))
        if re.search(SPEEDS, bare) and (by_table or re.search(WHEEL, bare)) and not re.search(NO_WHEEL, bare):
            found.append(name)
    rates = [n for n in found if not re.search(COUNTED, _plain(n))] or found
    rear = [n for n in rates if re.search(REAR, _plain(n))]
    units = {find_unit(n) for n in rates}
    return rear or (rates if len(units) == 1 and len(rates) in (2, 4) else rates[:1])


def has(name: str, pattern: str) -> bool:
    """Whether a pattern lies in the words of a name, its unit's among them."""
    return re.search(pattern, _plain(name)) is not None
