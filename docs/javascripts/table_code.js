// Code in tables breaks at spaces only: browsers also break after each "-" of a flag such as --config.seed.
for (const code of document.querySelectorAll(".md-typeset td code")) {
  const words = code.textContent.split(" ").map((word) => {
    const span = document.createElement("span");
    span.style.whiteSpace = "nowrap";
    span.textContent = word;
    return span;
  });
  code.replaceChildren(...words.flatMap((span, i) => (i ? [" ", span] : [span])));
}
