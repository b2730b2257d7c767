"""Table of the scan formats: their suffixes and readers. To support another format, add a row.

`open_scans`, the search for scans in a folder, error messages and `--help` read this table. The table
names its readers as text, so that the command line shows it without loading any reader.
"""

from typing import NamedTuple


class ScanFormat(NamedTuple):
    """One kind of scan file.

    suffix: ending of the file's name, in lower case.
    reader: module of `formats/` and its function (path) -> list[Scan]. It reads headers only and
    raises ScanError.
    bounds: module and function (path, units) -> bounds (2, 3) [m] or None, which reads the bounds
    that the header of a damaged file declares, and may raise anything; "": headers declare none.
    is_mesh: --spacing samples the surface.
    in_folders: read from folders; otherwise only if named, because text of any kind may hold notes.
    """

    suffix: str
    reader: str
    bounds: str = ""
    is_mesh: bool = False
    in_folders: bool = True

    @property
    def name(self) -> str:
        """Return the name of the format, as --help shows it."""
        return self.suffix.removeprefix(".").upper()


# A COPC file ends in ".copc.laz" and is a LAZ file.
FORMATS = (
    ScanFormat(".las", "las.open_las", bounds="las.las_bounds"),
    ScanFormat(".laz", "las.open_las", bounds="las.las_bounds"),
    ScanFormat(".e57", "e57.open_e57", bounds="e57.e57_bounds"),
    ScanFormat(".ply", "ply.open_ply", is_mesh=True),
    ScanFormat(".pcd", "pcd.open_pcd"),
    ScanFormat(".xyz", "text.open_text"),
    ScanFormat(".pts", "pts.open_pts"),
    ScanFormat(".ptx", "ptx.open_ptx"),
    ScanFormat(".txt", "text.open_text", in_folders=False),
    ScanFormat(".csv", "text.open_text", in_folders=False),
    ScanFormat(".obj", "mesh.open_obj", is_mesh=True),
    ScanFormat(".stl", "mesh.open_stl", is_mesh=True),
    ScanFormat(".glb", "glb.open_glb", is_mesh=True),
)

# Suffixes of scan formats without a reader. In a folder they are reported as errors, like broken
# scans, and not skipped silently.
UNSUPPORTED = frozenset(
    {
        ".fls",
        ".fws",
        ".gltf",
        ".lsproj",
        ".pod",
        ".ptb",
        ".ptg",
        ".ptz",
        ".rcp",
        ".rcs",
        ".rdbx",
        ".rxp",
        ".x3a",
        ".zfs",
        ".zlas",
    }
)
