"""Where was this frame taken?"""
