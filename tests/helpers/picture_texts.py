"""Where the texts of a figure are."""

from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text


def texts(figure):
    """Text and bounding box [pixel] of every text that is drawn."""
    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw_without_rendering()
    sides = [side for side in figure.findobj(Axis) if _shown(side)]
    of_ticks = {
        id(text) for side in figure.findobj(Axis) for tick in _ticks(side) for text in (tick.label1, tick.label2)
    }
    of_sides = {id(text) for side in figure.findobj(Axis) for text in (side.label, side.offsetText)}
    drawn = [text for text in figure.findobj(Text) if id(text) not in of_ticks | of_sides]
    for side in sides:
        drawn += [side.label, side.offsetText]
        drawn += [text for tick in side._update_ticks() for text in (tick.label1, tick.label2)]
    drawn = [text for text in drawn if text.get_visible() and text.get_text().strip() and _shown(text)]
    return [(text.get_text(), text.get_window_extent(renderer)) for text in drawn]


def cut(found, figure, slack=1.5):
    """Those of `texts` of which a part lies outside the figure."""
    width, height = figure.bbox.width, figure.bbox.height
    return [
        text
        for text, box in found
        if box.x0 < -slack or box.y0 < -slack or box.x1 > width + slack or box.y1 > height + slack
    ]


def overlapping(found, slack=1.0):
    """Pairs of `texts` whose boxes overlap by more than `slack` [pixel]."""
    return [
        (first, second)
        for number, (first, one) in enumerate(found)
        for second, other in found[:number]
        if min(one.x1, other.x1) - max(one.x0, other.x0) > slack
        and min(one.y1, other.y1) - max(one.y0, other.y0) > slack
    ]


def _ticks(side):
    return [*side.get_major_ticks(), *side.get_minor_ticks()]


def _shown(artist):
    """Whether what an artist belongs to is drawn."""
    axes = artist.axes
    if isinstance(artist, Axis) and (not artist.get_visible() or not axes.axison):
        return False
    return axes is None or axes.get_visible()
