"""Colours of filters, the same in every figure and page.

The first eight are Okabe & Ito's, which colour-blind readers can distinguish; the others are Paul Tol's. Truth is
black, an outage is shaded.
"""

COLOURS = (
    "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#6A3D9A", "#8C510A",
    "#882255", "#117733", "#332288", "#999933", "#44AA99", "#AA4499", "#661100", "#888888",
)  # fmt: skip
SHADE = "#DDDDDD"
TRUTH = "#000000"
# of fixes by NMEA's GGA code
QUALITY = {1: "#E69F00", 2: "#56B4E9", 3: "#56B4E9", 4: "#009E73", 5: "#CC79A7", 9: "#0072B2"}


def filter_colour(k: int) -> str:
    """Of the k-th filter."""
    return COLOURS[k % len(COLOURS)]
