"""What the compiled core is made of, as typed structs. Needs numpy and msgspec alone."""

from .encoding import Flags as Flags
from .encoding import Indices as Indices
from .encoding import Matrix as Matrix
from .encoding import Model as Model
from .encoding import Point as Point
from .encoding import Points as Points
from .encoding import Pose as Pose
from .encoding import Poses as Poses
from .encoding import Rotation as Rotation
from .encoding import Vector as Vector
from .encoding import encode as encode
from .encoding import unpacked as unpacked
from .limits import BoxLimits as BoxLimits
from .method import DistancesModel as DistancesModel
from .method import EstimatorModel as EstimatorModel
from .method import HomogeneousModel as HomogeneousModel
from .method import PalmModel as PalmModel
from .method import TeleoperationModel as TeleoperationModel
from .person import GuardModel as GuardModel
from .person import LandmarkReaderModel as LandmarkReaderModel
from .robot import RobotHandModel as RobotHandModel
from .robot import RobotModel as RobotModel
