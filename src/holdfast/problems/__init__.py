"""The problems: what the robot is to do, as plain objects of NumPy functions.

:mod:`problem` says what a problem is, :mod:`attributes` reads what it declares and :mod:`checked`
checks what its functions return. Each other module is one problem of holdfast's own or what several
have in common; :mod:`holdfast.config.registry` finds them by name.
"""
