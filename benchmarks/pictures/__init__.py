"""How pictures are decoded: sound, damaged and hostile ones."""
