// What Feed.cs makes of bytes: a line in, `header HEX` or `body HEX`; a line out, its values, or `refused`.

using System;
using System.Globalization;

public static class Cases
{
    public static int Main()
    {
        string line;
        while ((line = Console.ReadLine()) != null)
        {
            string[] words = line.Split(' ');
            byte[] bytes = Bytes(words[1]);
            try
            {
                Console.WriteLine(words[0] == "header" ? Header(bytes) : Position(bytes));
            }
            catch (FormatException)
            {
                Console.WriteLine("refused");
            }
        }
        return 0;
    }

    static string Header(byte[] bytes)
    {
        FeedHeader header = Feed.ReadHeader(bytes);
        return string.Join(" ", header.Version, header.Urgency, header.Seq, header.StampNs, header.AgeUs);
    }

    static string Position(byte[] bytes)
    {
        double[] at = Feed.PositionM(bytes);
        return string.Join(" ", Array.ConvertAll(at, value => value.ToString("R", CultureInfo.InvariantCulture)));
    }

    static byte[] Bytes(string hex)
    {
        var bytes = new byte[hex.Length / 2];
        for (int index = 0; index < bytes.Length; index++)
            bytes[index] = Convert.ToByte(hex.Substring(2 * index, 2), 16);
        return bytes;
    }
}
