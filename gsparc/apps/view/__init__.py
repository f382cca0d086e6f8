"""A model in three dimensions: what is drawn, what a place answers, pages,
pictures and splat files of it.
"""
