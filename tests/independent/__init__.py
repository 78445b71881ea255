"""The model a second time, by other means: nothing here imports stiffopt.

Formulas are taken literally from the paper (its equation numbers are cited) and from rod theory,
in plain NumPy and SciPy: products of exponentials by Pade approximation, sums over elements,
boundary integrals over the section, a rod integrated from the base with rotation matrices, a
boundary value problem by collocation, and a discrete energy.  What is tested against it shares
neither code nor method.  SI units; twists and wrenches linear part first.
"""
