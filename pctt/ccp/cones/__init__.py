"""Cones of contacts: of friction, and of friction with resistance to rolling and spinning."""

from pctt.ccp.cones.base import Cones
from pctt.ccp.cones.friction import FrictionCones
from pctt.ccp.cones.rolling import RollingCones

__all__ = ["Cones", "FrictionCones", "RollingCones"]
