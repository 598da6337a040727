"""Everything Overfly raises on purpose, in one tree.

    OverflyError                 work failed; the command line prints one line and exits with 1
    ├── UsageError               the caller asked for something impossible; exits with 2
    │   └── ConfigError          a setting that does not exist or does not fit
    ├── SourceError              a flight that cannot be read at all
    │   └── CalibrationError     a camera calibration that is missing or cannot be true
    ├── MapFileError             a map file that is damaged, foreign or from a newer Overfly
    ├── GraphFileError           a g2o, TORO or trajectory file that cannot be read
    └── OutputError              results that cannot be written (full disk, read-only folder)

One bad picture or row among many is not an error: readers report it as a :class:`overfly.types.Problem` and
go on. "Not found" is not an error either: see :class:`overfly.types.NotFound`.
"""


class OverflyError(Exception):
    """Base of all errors that are meant to be read by a person: one line, with the file and what to do."""

    exit_code = 1


class UsageError(OverflyError):
    """The command or call cannot mean anything: wrong option, wrong combination."""

    exit_code = 2


class ConfigError(UsageError):
    """A configuration key that does not exist, or a value outside its range."""


class SourceError(OverflyError):
    """A flight that cannot be opened or has nothing to work on."""


class CalibrationError(SourceError):
    """A camera calibration that is missing, incomplete or implausible."""


class MapFileError(OverflyError):
    """A map file that is damaged, not one of ours, or written by a newer version."""


class GraphFileError(OverflyError):
    """A pose graph or trajectory file that cannot be read."""


class OutputError(OverflyError):
    """Results could not be written."""
