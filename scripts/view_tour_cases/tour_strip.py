"""Strip of the tour: frames in two rows, each with a caption."""

from collections.abc import Sequence

import matplotlib
from PIL import Image, ImageDraw, ImageFont

_FRAME, _COLUMNS = (448, 252), 4
_GAP, _CAPTION, _SIZE = 10, 42, 20
GROUND, TEXT = (10, 14, 21), (230, 237, 245)


def strip(frames: Sequence[tuple[Image.Image, str]]) -> Image.Image:
    """Return frames (picture, caption) as one picture."""
    width, height = _FRAME
    rows = -(-len(frames) // _COLUMNS)
    made = Image.new(
        "RGB",
        (_COLUMNS * width + (_COLUMNS + 1) * _GAP, rows * (height + _CAPTION) + (rows + 1) * _GAP),
        GROUND,
    )
    draw = ImageDraw.Draw(made)
    font = caption_font(_SIZE)
    for number, (image, caption) in enumerate(frames):
        row, column = divmod(number, _COLUMNS)
        place = (_GAP + column * (width + _GAP), _GAP + row * (height + _CAPTION + _GAP))
        made.paste(image.resize(_FRAME, Image.Resampling.LANCZOS), place)
        draw.text((place[0] + 2, place[1] + height + _CAPTION / 2), caption, TEXT, font, anchor="lm")
    return reduced(made, 240)


def reduced(image: Image.Image, colours: int) -> Image.Image:
    """Return an image with a palette, in which the colour of its first pixel, the ground, is exact."""
    # Few points are red or yellow: this method keeps their colours.
    made = image.quantize(colours, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    palette, ground = list(made.getpalette()), made.getpixel((0, 0))
    palette[3 * ground : 3 * ground + 3] = image.getpixel((0, 0))
    made.putpalette(palette)
    return made


def caption_font(size: int) -> ImageFont.FreeTypeFont:
    """Return the font of captions: matplotlib's, the same on every machine."""
    return ImageFont.truetype(f"{matplotlib.get_data_path()}/fonts/ttf/DejaVuSans.ttf", size)
