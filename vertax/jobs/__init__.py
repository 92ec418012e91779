"""The jobs of `vertax run`: fits, designs and inference from images, on the public packages."""
