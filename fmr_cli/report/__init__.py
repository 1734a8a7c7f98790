"""What a person looks at: plots, pages, pictures, the viewer."""
