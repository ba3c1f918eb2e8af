from .display import Display as Display
