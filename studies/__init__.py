"""The experiments behind what the project claims, as code that yields tables and figures.

A *study* asks a question. It lists *tasks*, pure functions of plain data that can be computed
anywhere and in any order, and turns their results into tables, figures and numbers. Each result is
kept under the digest of all that it depends on, so an interrupted study goes on where it stopped,
and a finished one is drawn again at once.
"""
