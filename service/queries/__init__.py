"""Queries: where was this frame taken?"""
