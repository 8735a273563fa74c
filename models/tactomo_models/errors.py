"""What can go wrong in the models, each with its cause and the next step in the message.

ModelError
 ├── DescriptionError   a sensor description that cannot be read or makes no sense
 │                      ("paper.toml: electrodes.length_m = 0.08: must be below the pitch, 0.036")
 ├── ArtifactError      a built artifact that is missing, damaged or made for another sensor
 └── DataError          voltages of the wrong shape or kind
"""


class ModelError(Exception):
    """Base of everything that tactomo_models raises on purpose."""


class DescriptionError(ModelError):
    """A sensor description that cannot be read or makes no sense."""


class ArtifactError(ModelError):
    """A built artifact that is missing, damaged or made for another sensor."""


class DataError(ModelError):
    """Voltages of the wrong shape or kind."""
