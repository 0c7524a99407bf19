"""The errors and warnings of cvtgs; each is also the builtin that it specialises."""


class CvtgsError(Exception):
    """Base of every error that cvtgs raises on purpose; its text is one clear sentence."""


class InvalidArgumentError(CvtgsError, ValueError):
    """An argument is outside what the function accepts (a ratio, a count, a shape)."""


class InvalidSceneError(CvtgsError, ValueError):
    """The tensors given do not make up a scene (wrong shape, dtype or device)."""


class ConfigError(CvtgsError, ValueError):
    """A configuration has an unknown key, an unknown preset or a value out of range."""


class FileFormatError(CvtgsError, ValueError):
    """A file is not what its format promises; the text names path, property and row."""


class InputNotFoundError(CvtgsError, FileNotFoundError):
    """The file to read does not exist."""


class InputError(CvtgsError, OSError):
    """The file to read exists but cannot be read (a directory, no permission, a failing disk)."""


class OutputExistsError(CvtgsError, FileExistsError):
    """The file to write exists already and overwriting was not asked for."""


class OutputError(CvtgsError, OSError):
    """The output could not be written (missing directory, no permission, disk full)."""


class DeviceError(CvtgsError, RuntimeError):
    """The device that was asked for is not there, or cannot do what was asked."""


class CheckpointError(CvtgsError, ValueError):
    """A MergeNet checkpoint cannot be used."""


class TrainingError(CvtgsError, RuntimeError):
    """A training cannot go on; the text says where it stopped, and which file is good."""


class RunError(CvtgsError, RuntimeError):
    """A process that cvtgs started has failed; the text says why."""


class GoalError(CvtgsError, ValueError):
    """No result meets what was asked for (a quality, a time); the text says what comes closest."""


class MissingDependencyError(CvtgsError, ImportError):
    """An optional package is not installed; the text says what to install."""


class DroppedDataWarning(UserWarning):
    """Something in the input was left out; the text says what, how much and why."""
