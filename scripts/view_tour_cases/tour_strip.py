"""Strip of the tour: frames in two rows, each with a caption."""

from collections.abc import Sequence

import matplotlib
from PIL import Image, ImageDraw, ImageFont

_FRAME, _COLUMNS = (448, 252), 4
_GAP, _CAPTION, _SIZE = 10, 42, 20
_GROUND, _TEXT = (10, 14, 21), (230, 237, 245)


def strip(frames: Sequence[tuple[Image.Image, str]]) -> Image.Image:
    """Return frames (picture, caption) as one picture."""
    width, height = _FRAME
    rows = -(-len(frames) // _COLUMNS)
    made = Image.new(
        "RGB",
        (_COLUMNS * width + (_COLUMNS + 1) * _GAP, rows * (height + _CAPTION) + (rows + 1) * _GAP),
        _GROUND,
    )
    draw = ImageDraw.Draw(made)
    # The font is matplotlib's: the same on every machine.
    font = ImageFont.truetype(f"{matplotlib.get_data_path()}/fonts/ttf/DejaVuSans.ttf", _SIZE)
    for number, (image, caption) in enumerate(frames):
        row, column = divmod(number, _COLUMNS)
        place = (_GAP + column * (width + _GAP), _GAP + row * (height + _CAPTION + _GAP))
        made.paste(image.resize(_FRAME, Image.Resampling.LANCZOS), place)
        draw.text((place[0] + 2, place[1] + height + _CAPTION / 2), caption, _TEXT, font, anchor="lm")
    # Few points are red or yellow: they keep their colours.
    return made.quantize(240, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
