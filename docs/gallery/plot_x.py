"""
X
=
"""
import stiffopt
