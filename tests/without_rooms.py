"""The core's journey in a process without some rooms; ``test_rooms`` starts it.

``without_rooms.py FOLDER --short|--demo ROOM...``
"""

import contextlib
import sys
from pathlib import Path

from rooms import room_of

folder, how, *rooms = sys.argv[1:]


class Refuse:
    """A finder that has none of the modules of the rooms."""

    def find_spec(self, name, path=None, target=None):
        """Raise for a module of a room that has been taken out."""
        if room_of(name) in rooms:
            raise ModuleNotFoundError(f"No module named '{name}'", name=name)


sys.meta_path.insert(0, Refuse())

from calibrate.cli import main  # noqa: E402 - after the rooms are gone

data, out = Path(folder, "data.csv"), str(Path(folder, "run"))
data.write_text("node,ux,uy,uz\n3,0.5,0.0,-9.0\n7,0.4,0.1,-5.0\n11,0.2,0.0,-2.0\n")
journeys = [
    ["infer", "once_clamped_beam", "--data", str(data), "--no-unit-check", "--no-certify"],
    ["certify", out, "--draws", "25", "--no-mesh"],
    ["demo"],
]
with contextlib.suppress(SystemExit):
    main(["--help"])
for words in journeys[:1] if how == "--short" else journeys:
    where = [] if words[0] == "certify" else ["--out", out if words[0] == "infer" else folder]
    code = main([*words, *where])
    if code == 2 or (code == 1 and words[0] == "demo"):
        sys.exit(f"{words[0]} ended with {code}")
if "pages" in rooms:
    with contextlib.redirect_stderr(sys.stdout):
        assert main(["report", out]) == 2
loaded = [name for name in sys.modules if room_of(name) in rooms]
assert not loaded, loaded
