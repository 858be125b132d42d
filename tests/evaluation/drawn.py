"""The figures of a page, read back and checked by plotly, which knows every property of plotly.js."""

import json
import re

import plotly.graph_objects as go


def figures_of(page: str) -> dict[str, go.Figure]:
    """By their names; plotly refuses a property or a value that it does not know."""
    found = re.findall(r'<script type="application/json" id="data-([^"]+)">(.*?)</script>', page, flags=re.S)
    return {name: go.Figure(json.loads(text.replace("<\\/", "</"))) for name, text in found}
